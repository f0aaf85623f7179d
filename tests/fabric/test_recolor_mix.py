"""New colours for yarns, and fabrics between two others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import (
    PRESETS,
    SYSTEMS,
    YARN_PARAMETERS,
    FabricParameters,
    YarnParameters,
    hex_color,
    mixed,
    parse_color,
    preset,
    recolored,
)
from usdfab.fabric.mix import KINDS

RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

# --- colours ---------------------------------------------------------------------------------------------------------


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_hex_codes_round_trip(code: tuple[int, int, int]) -> None:
    text = "#{:02x}{:02x}{:02x}".format(*code)
    assert hex_color(parse_color(text)) == text == hex_color(parse_color(text.upper()))


def test_hex_is_srgb_and_numbers_are_linear() -> None:
    np.testing.assert_allclose(parse_color("#808080"), [0.2158605] * 3, rtol=1e-6)
    assert parse_color("#f00") == RED
    assert parse_color(" .5, 0 ,1") == (0.5, 0.0, 1.0)


@pytest.mark.parametrize(
    "text", ["", "red", "#12345", "#gggggg", "1,2,3", "-1,0,0", ".5", ".5,.5", "nan,0,0", "inf,0,0"]
)
def test_what_is_no_colour(text: str) -> None:
    with pytest.raises(UsdfabError, match=r"is no colour; write #rrggbb"):
        parse_color(text)


def test_recolor_dyes_systems_and_single_colours() -> None:
    striped = FabricParameters(warp=YarnParameters(yarn_albedo=(RED, GREEN, RED)), weft=YarnParameters(albedo=RED))
    navy = recolored(striped, ["warp=#000080"])
    assert navy.warp.colors() == (parse_color("#000080"),) and navy.weft == striped.weft
    both = recolored(striped, ["both=.1,.2,.3"])
    assert both.warp.colors() == both.weft.colors() == ((0.1, 0.2, 0.3),)
    swapped = recolored(striped, ["#ff0000->#0000ff"])
    assert swapped.warp.yarn_albedo == (BLUE, GREEN, BLUE) and swapped.weft.albedo == BLUE
    only = recolored(striped, ["warp:#f00 -> 0,0,1"])
    assert only.warp.yarn_albedo == (BLUE, GREEN, BLUE) and only.weft == striped.weft
    # One after the other, in order.
    assert recolored(striped, ["#f00->#00f", "#00f->#0f0"]).warp.yarn_albedo == (GREEN,) * 3


def test_hex_codes_find_colours_that_they_round() -> None:
    fabric = preset("denim")
    code = hex_color(fabric.warp.albedo)
    assert parse_color(code) != fabric.warp.albedo
    assert recolored(fabric, [f"{code}->#fff"]).warp.albedo == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("warp", "is no change of colour"),
        ("ward=#fff", "'ward' is neither warp, weft nor both"),
        ("west:#fff->#000", "'west' is neither"),
        ("#123456->#000", "no yarn is #123456; the colours are #354273, #e5dfd1"),
        ("weft:#354273->#000", "no yarn is #354273; the colours are #e5dfd1"),
        ("#354273->", "'' is no colour"),
        ("warp=#35427", "is no colour"),
    ],
)
def test_changes_that_are_refused(change: str, problem: str) -> None:
    with pytest.raises(UsdfabError, match=problem) as caught:
        recolored(preset("denim"), [change])
    assert caught.value.place == "--recolor"


# --- mixing ----------------------------------------------------------------------------------------------------------

names = st.sampled_from(sorted(PRESETS))


@given(names, names, st.floats(0, 1))
def test_every_number_lies_between(first: str, second: str, amount: float) -> None:
    a, b = preset(first), preset(second)
    between = mixed(a, b, amount)
    for system in SYSTEMS:
        yarns = [f.system(system) for f in (a, b, between)]
        for p in YARN_PARAMETERS:
            if p.kind in ("float", "int", "color"):
                low, high = np.sort([np.asarray(getattr(y, p.name), dtype=float) for y in yarns[:2]], axis=0)
                value = np.asarray(getattr(yarns[2], p.name), dtype=float)
                assert (value >= low).all() and (value <= high).all(), p.name
    assert between.weave in (a.weave, b.weave)


@given(names, names)
def test_the_ends_are_the_fabrics_themselves(first: str, second: str) -> None:
    a, b = preset(first), preset(second)
    assert mixed(a, b, 0.0) == a and mixed(a, b, 1.0) == b


def test_scales_are_mixed_by_logarithms_the_rest_linearly() -> None:
    base = YarnParameters()
    a = FabricParameters(size=(1e-3, 1e-3), warp=replace(base, radius=1e-4, fiber_count=100, crimp=0.4, albedo=RED))
    b = FabricParameters(size=(4e-3, 1e-3), warp=replace(base, radius=4e-4, fiber_count=400, crimp=0.8, albedo=BLUE))
    half = mixed(a, b, 0.5)
    assert half.warp.radius == pytest.approx(2e-4) and half.warp.fiber_count == 200
    assert half.warp.crimp == pytest.approx(0.6) and half.warp.albedo == (0.5, 0.0, 0.5)
    assert half.size == pytest.approx((2e-3, 1e-3))
    # Densities of 0 have no logarithm.
    hairy = replace(b, warp=replace(b.warp, flyaway_density=1000.0))
    assert mixed(a, hairy, 0.25).warp.flyaway_density == pytest.approx(250)


def test_kinds_are_the_nearer_ones() -> None:
    a, b = preset("linen"), preset("woollen-twill")
    near, far = mixed(a, b, 0.4), mixed(a, b, 0.6)
    assert (near.weave, near.name, near.seed) == (a.weave, a.name, a.seed) and far.weave == b.weave
    for name in KINDS:
        assert getattr(near.warp, name) == getattr(a.warp, name) and getattr(far.warp, name) == getattr(b.warp, name)
    assert mixed(a, b, 0.5).weave == a.weave
    assert "0.6 LinenPlain + 0.4 WoollenTwill" in near.provenance.source


def test_a_radius_of_0_stands_for_the_one_that_follows() -> None:
    a = FabricParameters(warp=YarnParameters(fiber_radius=0.0))
    b = FabricParameters(warp=YarnParameters(fiber_radius=1e-5))
    expected = (a.warp.effective_fiber_radius * 1e-5) ** 0.5
    assert mixed(a, b, 0.5).warp.fiber_radius == pytest.approx(expected)
    assert mixed(a, a, 0.5).warp.fiber_radius == 0.0


def test_stripes_are_mixed_side_by_side() -> None:
    two = FabricParameters(warp=YarnParameters(yarn_albedo=(RED, GREEN)))
    three = FabricParameters(warp=YarnParameters(yarn_albedo=(BLUE, BLUE, RED)))
    half = mixed(two, three, 0.5).warp.yarn_albedo
    assert len(half) == 6 and half[0] == (0.5, 0.0, 0.5) and half[2] == (1.0, 0.0, 0.0) and half[5] == (0.5, 0.5, 0.0)
    plain = FabricParameters(warp=YarnParameters(albedo=BLUE))
    assert mixed(two, plain, 0.5).warp.yarn_albedo == ((0.5, 0.0, 0.5), (0.0, 0.5, 0.5))


@pytest.mark.parametrize("amount", [-0.1, 1.1, float("nan")])
def test_amounts_that_are_refused(amount: float) -> None:
    with pytest.raises(UsdfabError, match=r"--mix: .* is not between 0"):
        mixed(preset("linen"), preset("denim"), amount)
