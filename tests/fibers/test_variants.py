"""Variants of the tile: the same at the border, other fibers inside, as smooth as the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.fabric import FabricParameters, YarnParameters, edited, preset, weave_from_name
from usdfab.fibers import FiberSystem, generate_patch, patch_variants
from usdfab.fibers.draws import BORDER_BAND, ramp, smoother_step, variation_weight
from usdfab.fibers.patch import SIDE_BAND, Patch
from usdfab.fibers.segments import lay_out


def _fabric(weave: str = "twill 2/2", **yarn: float) -> FabricParameters:
    system = YarnParameters(**({"fiber_count": 30, "radius": 1.5e-4, "count": 12} | yarn))
    return FabricParameters(weave_from_name(weave), (5e-3, 4e-3), system, system, seed=3)


def _pieces(patch: Patch) -> list[np.ndarray]:
    """Four control points for each piece of spline of each curve: the piece lies within their hull."""
    out = []
    for curves in patch.curves:
        fibers = isinstance(curves, FiberSystem)
        points, offsets = curves.extended(2, 3) if fibers else (curves.points, curves.offsets)
        curve = np.repeat(np.arange(curves.curves), np.diff(offsets))
        first = np.flatnonzero(curve[3:] == curve[:-3])
        out.append(points[first[:, None] + np.arange(4)])
    return out


def _same_border(a: Patch, b: Patch, cell: tuple[float, float]) -> bool:
    """Whether what differs keeps off the border, and so does not reach into any neighbouring tile either."""
    assert a.size == b.size and len(a.curves) == len(b.curves)
    for curves, one, other in zip(a.curves, _pieces(a), _pieces(b), strict=True):
        margin = SIDE_BAND * np.asarray(cell) + curves.radius
        differs = (one != other).any(axis=(1, 2))
        for pieces in (one[differs, :, :2], other[differs, :, :2]):
            if not np.all((pieces > margin) & (pieces < np.asarray(a.size) - margin)):
                return False
    return True


@pytest.mark.parametrize(
    ("weave", "values"),
    [
        ("twill 2/2", {}),
        ("satin 5/2", {"flattening": 2.2}),
        ("herringbone", {"twist": 0.2, "irregularity": 0.5}),
        ("twill 3/1", {"ply_count": 2, "twist": 0.21}),
        ("twill 2/2", {"flyaway_density": 5000, "flyaway_length": 5e-4}),
        ("plain", {"flyaway_density": 5000}),
    ],
)
def test_variants_agree_at_the_border(weave: str, values: dict) -> None:
    fabric = _fabric(weave, **values)
    first, *others = patch_variants(fabric, 12, (1, 1), 3)
    for other in others:
        assert _same_border(first, other, fabric.cell)


@settings(max_examples=15)
@given(
    st.sampled_from(["twill 2/2", "satin 5/2", "crepe"]),
    st.integers(1, 4),
    st.floats(0.3, 3.0),
    st.floats(-0.5, 0.5),
    st.floats(0, 1),
    st.integers(1, 10**6),
    st.integers(4, 20),
)
def test_variants_agree_at_the_border_whatever_the_yarn(weave, plies, flattening, twist, noise, variant, vertices):
    fabric = _fabric(
        weave, ply_count=plies, flattening=flattening, twist=twist, irregularity=noise, fiber_count=9,
        flyaway_density=1000,
    )  # fmt: skip
    first, other = generate_patch(fabric, vertices), generate_patch(fabric, vertices, variant=variant)
    assert _same_border(first, other, fabric.cell)


@pytest.mark.parametrize("name", ["canvas", "wool-twill", "silk-satin", "woollen-twill"])
def test_inside_variants_differ_from_each_other(name: str) -> None:
    patches = patch_variants(preset(name), 12, (1, 1), 3)
    for k, a in enumerate(patches):
        for b in patches[:k]:
            for one, other in zip(a.systems, b.systems, strict=True):
                distance = np.linalg.norm(one.points - other.points, axis=1)
                # Fibers change places: they move by more than they are thick.
                assert (distance > 2 * one.radius).mean() > 0.2
            for one, other in zip(a.flyaways, b.flyaways, strict=True):
                moved = (one.points != other.points).reshape(one.curves, -1).any(axis=1)
                assert 0.2 < moved.mean() < 1.0


def test_no_curve_that_varies_leaves_the_tile_sideways() -> None:
    for name in ("canvas", "silk-satin", "woollen-twill"):
        fabric = preset(name)
        patches = patch_variants(fabric, 12, (1, 1), 3)
        for index, across in ((0, 0), (1, 1)):
            systems = [p.systems[index] for p in patches]
            lengths = systems[0].offsets[:-1]
            varies = np.logical_or.reduceat((systems[1].points != systems[0].points).any(axis=1), lengths)
            assert varies.any()
            for system in systems[:2]:
                low = np.minimum.reduceat(system.points[:, across], lengths)[varies] - system.radius
                high = np.maximum.reduceat(system.points[:, across], lengths)[varies] + system.radius
                assert low.min() > SIDE_BAND * fabric.cell[across]
                assert high.max() < patches[0].size[across] - SIDE_BAND * fabric.cell[across]


def _bends(patch: Patch) -> np.ndarray:
    """Second differences along all fibers, in fiber radii."""
    out = []
    for system in patch.systems:
        points, offsets = system.extended(1, 1)
        second = np.linalg.norm(np.diff(points, n=2, axis=0), axis=1)
        curve = np.repeat(np.arange(system.curves), np.diff(offsets))
        out.append(second[curve[2:] == curve[:-2]] / system.radius)
    return np.concatenate(out)


@pytest.mark.parametrize(("name", "copies"), [("canvas", (1, 1)), ("wool-twill", (1, 1)), ("woollen-twill", (2, 2))])
def test_variants_are_as_smooth_as_the_first(name: str, copies: tuple[int, int]) -> None:
    first, *others = (_bends(p) for p in patch_variants(preset(name), 40, copies, 3))
    for other in others:
        for q in (0.9, 0.99, 0.999):
            assert np.quantile(other, q) < 1.3 * np.quantile(first, q)
        assert other.max() < 1.5 * first.max()


def test_the_weight_is_flat_at_the_border_and_one_in_the_middle() -> None:
    layout = lay_out(weave_from_name("twill 2/2"), "warp", 40)
    band, width = ramp(layout, 0.05)
    assert band == BORDER_BAND and 0 < width <= 0.5 * layout.length - band
    weight = variation_weight(layout, 0.05)[: layout.first[1]]
    position = layout.position[: layout.first[1]]
    border = np.minimum(position, layout.length - position)
    assert not weight[border <= band].any()
    assert (weight[border >= band + width] == 1).all() and (weight == 1).mean() > 0.4
    h = 1e-4
    for end in (0.0, 1.0):
        values = smoother_step(np.array([end - h, end, end + h]))
        assert abs(values[2] - values[0]) < 1e-6 * h and abs(values[2] - 2 * values[1] + values[0]) < 0.1 * h * h


def test_variants_share_their_height_and_variant_0_is_the_patch() -> None:
    fabric = edited(preset("woollen-twill"), {"variants": "3"})
    patches = patch_variants(fabric, 8)
    assert len(patches) == fabric.variants == 3
    alone = [generate_patch(fabric, 8, variant=k) for k in range(3)]
    low, high = min(p.z_range[0] for p in alone), max(p.z_range[1] for p in alone)
    for a, b in zip(patches, alone, strict=True):
        assert a.z_range == (low, high)
        assert all(np.array_equal(x.points, y.points) for x, y in zip(a.curves, b.curves, strict=True))
    plain = generate_patch(fabric, 8)
    assert np.array_equal(plain.warp.points, patches[0].warp.points)
    assert len({p.z_range for p in alone}) > 1  # else sharing shows nothing


def test_a_patch_of_two_cells_can_still_stand_in_for_itself() -> None:
    fabric = replace(_fabric("plain"), variants=2)
    a, b = patch_variants(fabric, 8)
    assert _same_border(a, b, fabric.cell)


def test_variants_are_numbered_from_0() -> None:
    with pytest.raises(ValueError, match="from 0"):
        generate_patch(_fabric(), 8, variant=-1)
