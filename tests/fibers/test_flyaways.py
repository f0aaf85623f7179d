"""Flyaways: how many, how long, how far off; hairs and loops; where they start and end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, preset, weave_from_name
from usdfab.fibers import OpenCurves, generate_patch
from usdfab.fibers.flyaways import MAX_PER_YARN, flyaway_counts

RADIUS = 1e-4
STRAIGHT = {"crimp": 0.0, "twist": 0.0, "irregularity": 0.0, "radius": RADIUS, "fiber_count": 4, "count": 10}


def _fabric(weave: str = "satin 5/2", **yarn: float) -> FabricParameters:
    system = YarnParameters(**(STRAIGHT | {"flyaway_density": 2e4, "flyaway_length": 4e-4} | yarn))
    return FabricParameters(weave_from_name(weave), (5e-3, 5e-3), system, system, seed=3)


def _warp(fabric: FabricParameters, vertices: int = 80) -> tuple[OpenCurves, np.ndarray, np.ndarray]:
    """The warp's flyaways, their points (curves, vertices, 3), and the distances of these from the yarn's axis."""
    warp = generate_patch(fabric, vertices, (2, 2)).flyaways[0]
    points = warp.points.reshape(warp.curves, -1, 3)
    axis = (warp.yarn[:, None] + 0.5) * fabric.cell[0]
    return warp, points, np.hypot(points[..., 0] - axis, points[..., 2])


def test_none_by_default_and_fibers_do_not_change() -> None:
    without, with_them = generate_patch(_fabric(flyaway_density=0.0), 8), generate_patch(_fabric(), 8)
    assert without.flyaways == () and without.curves == without.systems
    assert [f.system for f in with_them.flyaways] == ["warp", "weft"]
    for a, b in zip(without.systems, with_them.systems, strict=True):
        assert np.array_equal(a.points, b.points)


def test_only_systems_with_flyaways_have_them() -> None:
    fabric = _fabric()
    patch = generate_patch(replace(fabric, warp=replace(fabric.warp, flyaway_density=0.0)), 8)
    assert [f.system for f in patch.flyaways] == ["weft"]


@pytest.mark.parametrize("density", [300.0, 4e3, 5e4])
def test_density(density: float) -> None:
    fabric = _fabric(flyaway_density=density)
    patch = generate_patch(fabric, 8, (4, 4))
    for flyaways, size in zip(patch.flyaways, patch.size[::-1], strict=True):
        expected = 20 * size * density
        # Each of the 20 yarns rounds up or down at random: a variance of at most 1/4 each.
        assert abs(flyaways.curves - expected) <= 4 * np.sqrt(20 / 4)
        assert flyaways.yarn.max() < 20
        counts = np.bincount(flyaways.yarn, minlength=20)
        assert np.ptp(counts) <= 1
        assert np.array_equal(flyaways.number, np.concatenate([np.arange(c) for c in counts]))


def test_counts_round_without_bias() -> None:
    counts = flyaway_counts(100.0, 3.3e-3, 20_000, 1, "warp")
    assert set(np.unique(counts)) == {0, 1}
    assert counts.mean() == pytest.approx(0.33, abs=4 * np.sqrt(0.33 * 0.67 / 20_000))


def test_loop_fraction() -> None:
    for fraction in (0.0, 0.3, 1.0):
        warp, _, _ = _warp(_fabric(flyaway_loop_fraction=fraction), 8)
        spread = np.sqrt(fraction * (1 - fraction) / warp.curves)
        assert abs(warp.loop.mean() - fraction) <= 4 * spread


@pytest.mark.parametrize("length", [2e-4, 1e-3])
def test_length_outside_the_yarn(length: float) -> None:
    warp, points, _ = _warp(_fabric(flyaway_length=length))
    arc = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
    # Each end inside the yarn is 0.6 radii long; loops have two.
    outside = arc - 0.6 * RADIUS * (1 + warp.loop)
    error = 4 * outside.std() / np.sqrt(warp.curves)
    assert abs(outside.mean() - length) <= error + 0.1 * length
    assert outside.std() == pytest.approx(0.42 * length, rel=0.3)


def test_hairs_start_in_the_yarn_and_end_outside_loops_end_inside() -> None:
    warp, _, distance = _warp(_fabric())
    assert distance[:, 0].max() < 0.9 * RADIUS
    hairs, loops = distance[~warp.loop], distance[warp.loop]
    assert np.mean(hairs[:, -1] > RADIUS) > 0.99
    assert np.quantile(hairs[:, -1], 0.5) > 2 * RADIUS
    assert loops[:, -1].max() < RADIUS
    assert np.mean(loops.max(axis=1) > RADIUS) > 0.95
    # Hairs rise, once they have left: the last quarter is farther out than the second.
    quarter = hairs.shape[1] // 4
    assert np.mean(hairs[:, -quarter:].mean(axis=1) > hairs[:, quarter : 2 * quarter].mean(axis=1)) > 0.97


def test_spread_raises_them() -> None:
    tips = [
        np.median(_warp(_fabric(flyaway_spread=s, flyaway_loop_fraction=0.0))[2][:, -1]) for s in (0, 0.3, 0.6, 0.9)
    ]
    assert tips[0] < RADIUS and np.all(np.diff(tips) > 0.2 * RADIUS)


def test_they_follow_the_twist_of_the_yarn_where_they_lie_on_it() -> None:
    for twist in (0.3, -0.3):
        warp, points, _ = _warp(_fabric(twist=twist, flyaway_spread=0.0, flyaway_loop_fraction=1.0))
        # The middle of a loop that lies flat: it may bend sideways either way, but turns with the yarn on average.
        x = -(points[..., 0] - (warp.yarn[:, None] + 0.5) * 5e-4)
        angle = np.unwrap(np.arctan2(points[..., 2], x), axis=1)
        cells = (points[:, -1, 1] - points[:, 0, 1]) / 5e-4
        turned = (angle[:, -1] - angle[:, 0]) / (2 * np.pi)
        assert np.polyfit(cells, turned, 1)[0] == pytest.approx(twist, abs=0.05)


def test_they_follow_the_centre_line() -> None:
    fabric = _fabric("plain", crimp=1.0, flyaway_spread=0.0, flyaway_length=1e-3)
    warp, points, _ = _warp(fabric)
    weave = fabric.weave.matrix
    cell = np.floor(points[..., 1] / fabric.cell[1]).astype(int) % 2
    middle = np.abs(points[..., 1] / fabric.cell[1] % 1.0 - 0.5) < 0.1
    on_face = weave[cell, warp.yarn[:, None] % 2] == 0
    assert points[middle & on_face, 2].mean() == pytest.approx(RADIUS, rel=0.15)
    assert points[middle & ~on_face, 2].mean() == pytest.approx(-RADIUS, rel=0.15)


def test_plied_yarns_carry_them_on_their_plies() -> None:
    # Roots of a two-ply yarn lie in one of two circles of half the yarn's radius that touch at its axis and turn.
    fabric = _fabric(ply_count=2, twist=0.2, ply_twist=-0.2)
    patch = generate_patch(replace(fabric, warp=replace(fabric.warp, fiber_count=60)), 80)
    warp, fibers = patch.flyaways[0], patch.warp
    roots = warp.points[warp.offsets[:-1]]
    near = [np.abs(fibers.points - root).max(axis=1).min() for root in roots]
    assert np.quantile(near, 0.95) < 0.35 * RADIUS


def test_pinned_splines_start_and_end_at_the_ends() -> None:
    warp = generate_patch(_fabric(), 20).flyaways[0]
    points, offsets = warp.pinned()
    weights = np.array([1, 4, 1]) / 6
    first = np.stack([weights @ points[s : s + 3] for s in offsets[:-1]])
    last = np.stack([weights @ points[e - 3 : e] for e in offsets[1:]])
    assert first == pytest.approx(warp.points[warp.offsets[:-1]], abs=1e-15)
    assert last == pytest.approx(warp.points[warp.offsets[1:] - 1], abs=1e-15)
    low, high = warp.bounds
    assert np.all(low[0] <= warp.points[: warp.offsets[1]]) and np.all(high[0] >= warp.points[: warp.offsets[1]])


def test_they_count_for_the_height_of_the_patch() -> None:
    patch = generate_patch(_fabric(flyaway_spread=0.9), 20)
    highest = max(f.points[:, 2].max() + f.radius for f in patch.flyaways)
    assert patch.z_range[1] == highest > max(s.points[:, 2].max() + s.radius for s in patch.systems)


def test_a_seed_fixes_them_and_another_changes_them() -> None:
    fabric = preset("woollen-twill")
    a, b, c = (generate_patch(f, 8).flyaways[1] for f in (fabric, fabric, replace(fabric, seed=4)))
    assert np.array_equal(a.points, b.points) and a.points[0].tolist() != c.points[0].tolist()


def test_yarn_dyed_cloth_has_flyaways_of_its_colors() -> None:
    fabric = _fabric(yarn_albedo=((1, 0, 0), (0, 0, 1)))
    warp = generate_patch(fabric, 8).flyaways[0]
    assert np.array_equal(warp.albedo, np.array([(1, 0, 0), (0, 0, 1)])[warp.yarn % 2])


def test_too_many_are_refused() -> None:
    with pytest.raises(UsdfabError, match=rf"warp.flyaway_density: .* above {MAX_PER_YARN}"):
        flyaway_counts(1e6, 0.1, 1, 0, "warp")


@settings(max_examples=20)
@given(
    st.floats(1e-6, 2e-2),
    st.floats(0, 1),
    st.floats(0, 1),
    st.integers(1, 4),
    st.floats(-4, 4),
    st.integers(4, 12),
)
def test_any_parameters_give_finite_curves(length, spread, loops, plies, twist, vertices) -> None:
    fabric = _fabric(
        "plain", flyaway_length=length, flyaway_spread=spread, flyaway_loop_fraction=loops, ply_count=plies, twist=twist
    )
    for flyaways in generate_patch(fabric, vertices).flyaways:
        assert np.isfinite(flyaways.points).all()
        # Curves have no points upon each other, which would have no tangent.
        steps = np.linalg.norm(np.diff(flyaways.points.reshape(flyaways.curves, -1, 3), axis=1), axis=2)
        assert steps.min() > 0
