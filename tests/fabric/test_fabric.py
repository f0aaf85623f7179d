"""The parameter table, validation, editing by name, presets, sampling."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import (
    PAPER_WEAVES,
    PRESETS,
    YARN_PARAMETERS,
    FabricParameters,
    YarnParameters,
    as_table,
    edited,
    parse_length,
    parse_size,
    preset,
    sample_fabric,
)


def test_table_and_dataclass_have_the_same_rows() -> None:
    assert [p.name for p in YARN_PARAMETERS] == [f.name for f in dataclasses.fields(YarnParameters)]


@pytest.mark.parametrize("parameter", YARN_PARAMETERS, ids=lambda p: p.name)
def test_ranges_nest_and_hold_the_default(parameter) -> None:
    low, high = parameter.hard
    assert low <= parameter.soft[0] < parameter.soft[1] <= high
    assert parameter.doc.endswith(".")
    YarnParameters(**{parameter.name: parameter.default})


@pytest.mark.parametrize("parameter", [p for p in YARN_PARAMETERS if p.kind in ("float", "int")], ids=lambda p: p.name)
def test_values_outside_the_hard_range_are_refused(parameter) -> None:
    low, high = parameter.hard
    for value in (low - 1, high + 1, math.nan, math.inf, "much"):
        with pytest.raises(UsdfabError, match=parameter.name):
            YarnParameters(**{parameter.name: value})


@pytest.mark.parametrize("color", [(0.1, 0.2), (0.1, 0.2, 1.2), (math.nan, 0, 0), "red"])
def test_bad_colors_are_refused(color) -> None:
    with pytest.raises(UsdfabError, match="albedo"):
        YarnParameters(albedo=color)


def test_fiber_radius_follows_the_packing_unless_given() -> None:
    yarn = YarnParameters(radius=1e-4, flattening=2.0, packing=0.32, fiber_count=100)
    area = math.pi * yarn.radius**2 * yarn.flattening
    assert 100 * math.pi * yarn.effective_fiber_radius**2 / area == pytest.approx(0.32)
    assert dataclasses.replace(yarn, fiber_radius=5e-6).effective_fiber_radius == 5e-6


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_real_cloth(name: str) -> None:
    fabric = preset(name)
    for system in ("warp", "weft"):
        assert 0.7 <= fabric.cover(system) <= 1.15
        assert 1.5e-6 < fabric.system(system).effective_fiber_radius < 2.5e-5
        assert 5 < fabric.system(system).count / (fabric.size[0 if system == "warp" else 1] * 100) < 150
    json.dumps(as_table(fabric))


def test_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(UsdfabError, match="taffeta"):
        preset("tweed")


@pytest.mark.parametrize("weave", PAPER_WEAVES)
def test_sampled_fabrics_are_possible_cloth(weave: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        fabric = sample_fabric(weave, rng)
        assert fabric.weave.name == weave
        assert all(0.75 <= fabric.cover(s) <= 1.2 for s in ("warp", "weft"))


def test_sampling_depends_on_the_generator_alone() -> None:
    a, b = (sample_fabric("twill1", np.random.default_rng(7)) for _ in range(2))
    assert a == b


def test_editing_by_name() -> None:
    fabric = edited(
        FabricParameters(),
        {
            "warp.albedo": ".1,.2,.5",
            "both.radius": "120um",
            "weave": "twill 2/2",
            "size": "3.6mm",
            "weft.yarn_albedo": "1,0,0;0,1,0",
            "weft.fiber_count": "60",
            "warp.ply_count": "2",
            "warp.flyaway_length": "0.4mm",
            "variants": "2",
        },
    )
    assert fabric.warp.albedo == (0.1, 0.2, 0.5)
    assert fabric.warp.radius == fabric.weft.radius == pytest.approx(1.2e-4)
    assert fabric.weave.classify() == "twill"
    assert fabric.size == pytest.approx((3.6e-3, 3.6e-3))
    assert fabric.repeat() == (4, 4)
    assert fabric.weft.fiber_count == 60
    assert (fabric.warp.ply_count, fabric.weft.ply_count) == (2, 1)
    assert fabric.warp.flyaway_length == pytest.approx(4e-4)
    assert fabric.variants == as_table(fabric)["variants"] == 2


def test_colors_lengthen_the_repeat() -> None:
    fabric = edited(FabricParameters(), {"warp.yarn_albedo": "1,0,0;0,1,0;0,0,1"})
    assert fabric.repeat() == (2, 6)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("warp.colour", "1"),
        ("weft", "1"),
        ("warp.radius", "thick"),
        ("warp.radius", "-1mm"),
        ("warp.fiber_count", "1.5"),
        ("weave", "tartan"),
        ("size", "0mm"),
        ("size", "1,2,3"),
        ("seed", "-1"),
        ("variants", "0"),
        ("variants", "17"),
        ("variants", "many"),
        ("both.ply_count", "5"),
        ("both.flyaway_density", "-1"),
    ],
)
def test_bad_edits_are_refused(key: str, value: str) -> None:
    with pytest.raises(UsdfabError):
        edited(FabricParameters(), {key: value})


@given(st.floats(1e-6, 9.0), st.sampled_from([("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("cm", 1e-2), ("in", 0.0254)]))
def test_lengths_with_units(value: float, unit: tuple[str, float]) -> None:
    assert parse_length(f"{value!r}{unit[0]}") == pytest.approx(value * unit[1])
    assert parse_length(f" {value!r} {unit[0]}") == pytest.approx(value * unit[1])


@pytest.mark.parametrize(
    ("text", "size"),
    [("3.6mm", (3.6e-3, 3.6e-3)), ("3.6x2mm", (3.6e-3, 2e-3)), ("1cm,2mm", (1e-2, 2e-3)), ("0.004", (0.004, 0.004))],
)
def test_sizes(text: str, size: tuple[float, float]) -> None:
    assert parse_size(text) == pytest.approx(size)
