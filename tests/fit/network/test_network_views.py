"""Turned, cropped and recoloured pictures fit the fabrics that are said to be on them; targets go there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.sampling import sample_fabric
from usdfab.fabric.sampling_weaves import sample_weave
from usdfab.fabric.sampling_wide import sample_class, sample_wide
from usdfab.fabric.weave import NAMED_WEAVES, PAPER_WEAVES, twill
from usdfab.fit.network.labels import FAMILIES, LABELS, family_of, typical_weave, weave_label
from usdfab.fit.network.targets import INDEX, NAMES, TARGETS, decode, encode
from usdfab.fit.network.turns import TURNS, Turn, cropped, recolored
from usdfab.fit.network.unevenness import Unevenness, _smooth_noise, sample_unevenness, uneven
from usdfab.fit.network.views import view


def drawdown(fabric: FabricParameters, cell: int = 4) -> np.ndarray:
    """(H, W, 3): each crossing a square in its upper yarn's colour; warp.count x weft.count crossings, row 0 on top."""
    matrix = fabric.weave.matrix
    rows, columns = int(fabric.weft.count), int(fabric.warp.count)
    weft_up = matrix[np.arange(rows)[:, None] % len(matrix), np.arange(columns) % matrix.shape[1]]
    pixels = np.where(weft_up[..., None] == 1, fabric.weft.albedo, fabric.warp.albedo)[::-1]
    return pixels.repeat(cell, axis=0).repeat(cell, axis=1)


def cloth(weave: str = "twill0", ends: int = 6, picks: int = 9) -> FabricParameters:
    warp = YarnParameters(count=ends, albedo=(0.1, 0.2, 0.3), twist=0.1)
    weft = YarnParameters(count=picks, albedo=(0.7, 0.8, 0.9), twist=-0.2, irregularity=0.4)
    return FabricParameters(NAMED_WEAVES[weave], (3e-3, 4e-3), warp, weft)


@pytest.mark.parametrize("turn", TURNS)
def test_the_turned_picture_shows_the_turned_fabric(turn: Turn) -> None:
    fabric = cloth()
    assert fabric.warp.count % fabric.weave.ends == 0 and fabric.weft.count % fabric.weave.picks == 0
    np.testing.assert_array_equal(turn.picture(drawdown(fabric)), drawdown(turn.fabric(fabric)))


@pytest.mark.parametrize("turn", TURNS)
def test_spacing_and_twist_after_a_turn(turn: Turn) -> None:
    fabric = cloth()
    turned = turn.fabric(fabric)
    odd = turn.quarters % 2 == 1
    assert turned.cell == (fabric.cell[::-1] if odd else fabric.cell)
    assert turned.size == (fabric.size[::-1] if odd else fabric.size)
    # A mirror makes S of Z; a turn does not.
    twists = [fabric.warp.twist, fabric.weft.twist]
    expected = [-t if turn.mirrored else t for t in (twists[::-1] if odd else twists)]
    assert [turned.warp.twist, turned.weft.twist] == expected


def test_a_crop_keeps_the_cloth_and_shows_less_of_it() -> None:
    fabric = cloth("plain", 8, 8)
    pixels = drawdown(fabric, 8)
    part, shown = cropped(pixels, fabric, 0.5, (1.0, 0.0))
    np.testing.assert_array_equal(part, pixels[:32, 32:])
    assert (shown.warp.count, shown.weft.count) == (4, 4)
    assert shown.cell == pytest.approx(fabric.cell)
    assert shown.cover("warp") == pytest.approx(fabric.cover("warp"))


def test_channels_drawn_anew() -> None:
    fabric = replace(cloth(), warp=replace(cloth().warp, yarn_albedo=((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))))
    pixels, shown = recolored(drawdown(cloth()), fabric, (2, 2, 0))
    assert shown.weft.albedo == (0.9, 0.9, 0.7)
    assert shown.warp.yarn_albedo == ((0.3, 0.3, 0.1), (0.6, 0.6, 0.4))
    np.testing.assert_array_equal(pixels, drawdown(recolored(drawdown(cloth()), cloth(), (2, 2, 0))[1]))


def test_uneven_cloth_keeps_its_mean_spacing() -> None:
    fabric = cloth("plain", 10, 14)
    pixels = drawdown(fabric, 20).astype(np.float32)
    same = uneven(pixels, fabric, Unevenness(), np.random.default_rng(0))
    np.testing.assert_allclose(same, pixels, atol=1e-6)
    # Borders between columns of a row of plain weave lie where yarns meet.
    shifts, gains = [], []
    for seed in range(30):
        moved = uneven(pixels, fabric, Unevenness((0.1, 0.0)), np.random.default_rng(seed))
        borders = np.flatnonzero(np.abs(np.diff(moved[5, :, 0])) > 0.25)
        places = [borders[np.abs(borders - 20 * k).argmin()] + 1 for k in range(1, 10)]
        shifts.append(np.array(places) - 20.0 * np.arange(1, 10))
        bright = uneven(pixels, fabric, Unevenness(gain=(0.0, 0.2)), np.random.default_rng(seed))
        gains.append(np.log(bright[10::20, 5, 0] / pixels[10::20, 5, 0]))
    assert abs(np.mean(shifts)) < 0.4 and np.std(shifts) == pytest.approx(2.0, rel=0.25)
    assert abs(np.mean(gains)) < 0.04 and np.std(gains) == pytest.approx(0.2, rel=0.25)
    assert 0.0 <= sample_unevenness(np.random.default_rng(1)).bend <= 0.5


def test_bent_cloth_keeps_its_count() -> None:
    for seed in range(5):
        noise = _smooth_noise((40, 60), np.random.default_rng(seed))
        for axis in (0, 1):
            slope = np.polyfit(np.arange(noise.shape[axis]), noise.mean(axis=1 - axis), 1)[0]
            assert slope == pytest.approx(0.0, abs=1e-12)
        assert 0.4 < noise.std() < 1.6


def test_views_are_the_same_each_time_and_the_first_is_the_render() -> None:
    fabric = sample_fabric("twill0", np.random.default_rng(1))
    pixels = np.random.default_rng(2).uniform(0.0, 1.0, (64, 64, 3)).astype(np.float32)
    plain, same = view(pixels, fabric, 7, 0)
    assert same == fabric and plain.shape == (256, 256, 3)
    # Even views have seen no camera: a grey render stays grey.
    clean, _ = view(np.full_like(pixels, 0.5), fabric, 7, 2)
    np.testing.assert_allclose(clean, clean[0, 0, 0], rtol=1e-4)
    again = [view(pixels, fabric, 7, 3) for _ in range(2)]
    np.testing.assert_array_equal(again[0][0], again[1][0])
    assert again[0][1] == again[1][1]
    assert not np.array_equal(again[0][0], view(pixels, fabric, 8, 3)[0])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_targets_there_and_back(seed: int, wide: bool) -> None:
    rng = np.random.default_rng(seed)
    fabric = sample_wide(sample_class(rng), rng) if wide else sample_fabric(PAPER_WEAVES[seed % 7], rng)
    values, known = encode(fabric)
    found = decode(values)
    for row, system in enumerate(("warp", "weft")):
        yarn = fabric.system(system)  # type: ignore[arg-type]
        side = fabric.size[row]
        assert found["count"][row] == pytest.approx(yarn.count)
        assert found["radius"][row] * side == pytest.approx(yarn.radius)
        assert found["cover"][row] == pytest.approx(fabric.cover(system))  # type: ignore[arg-type]
        assert found["flattening"][row] == pytest.approx(max(yarn.flattening, 1.0))
        for name in ("fiber_count", "twist", "irregularity", "migration", "roughness_azimuthal", "packing"):
            assert found[name][row] == pytest.approx(getattr(yarn, name), rel=1e-6, abs=1e-9)
        assert found["inclination"][row] == pytest.approx(yarn.inclination, abs=2e-3)
        assert found["flyaways"][row] == pytest.approx(yarn.flyaway_density * side / yarn.count, abs=1e-9)
        assert known[row, INDEX["albedo_r"]] == (not yarn.yarn_albedo)
        if not yarn.yarn_albedo:
            assert found["albedo_g"][row] == pytest.approx(yarn.albedo[1], abs=2e-3)
    assert np.isfinite(values).all() and values.shape == (2, len(TARGETS)) and len(set(NAMES)) == len(NAMES)


def test_labels_cover_every_weave_and_know_their_families() -> None:
    rng = np.random.default_rng(3)
    drawn = {weave_label(sample_weave(sample_class(rng), rng)) for _ in range(300)}
    assert drawn == set(LABELS)
    for label in LABELS:
        assert weave_label(typical_weave(label)) == label
        assert family_of(label) in FAMILIES
    assert weave_label(twill(2, 2)) == "other_twill" and family_of("twill1_rot90") == "twill"
    with pytest.raises(UsdfabError, match="no weave label"):
        typical_weave("velvet")
