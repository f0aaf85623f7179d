"""Uneven, wandering yarns: statistics, where they lie, closed patches, variants and gradients."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fibers import YarnShape, draw, fiber_offsets, generate_patch, lay_out, patch_variants, successors
from usdfab.fibers.unevenness import highest, interpolated

YARN = YarnParameters(count=8, radius=1.2e-4, fiber_count=40, twist=0.1, irregularity=0.0)
CLOTH = FabricParameters(weave_from_name("twill 2/2"), (5e-3, 5e-3), YARN, YARN, seed=5)


def uneven(cloth: FabricParameters = CLOTH, **numbers: float) -> FabricParameters:
    return replace(cloth, warp=replace(cloth.warp, **numbers), weft=replace(cloth.weft, **numbers))


def test_curves_have_variance_one_and_are_periodic() -> None:
    rng = np.random.default_rng(0)
    knots = rng.normal(size=(4000, 4))
    yarn = np.arange(4000)[:, None]
    place = np.linspace(0, 4, 16, endpoint=False)[None, :]
    values = interpolated(knots, yarn, place)
    assert values.mean() == pytest.approx(0.0, abs=0.02)
    assert values.std() == pytest.approx(1.0, abs=0.02)
    assert interpolated(knots, yarn, place + 4.0) == pytest.approx(values, abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), place=st.floats(-20, 20))
def test_curves_are_smooth_and_bounded(seed: int, place: float) -> None:
    knots = np.random.default_rng(seed).normal(size=(1, 5))
    zero = np.zeros(1, dtype=np.int64)
    near = [float(interpolated(knots, zero, np.array([place + d]))[0]) for d in (-1e-3, 0.0, 1e-3)]
    assert abs(near[1]) <= highest(knots)[0] + 1e-12
    # The second derivative of a cubic B-spline is bounded by those of its knots: no kink at the cells' borders.
    assert abs(near[0] - 2 * near[1] + near[2]) <= 1e-6 * 4.1 * highest(knots)[0]


def _yarns(cloth: FabricParameters, system: str) -> tuple[np.ndarray, np.ndarray]:
    """(yarns, stations): sideways middle and sideways spread of the fibers of each yarn, metres."""
    curves = generate_patch(cloth, 12).systems[("warp", "weft").index(system)]
    fibers = cloth.system(system).fiber_count  # type: ignore[arg-type]
    axis = 1 if system == "weft" else 0
    points = curves.points.reshape(-1, fibers, len(curves.points) // curves.curves, 3)[..., axis]
    return points.mean(axis=1), points.std(axis=1)


@pytest.mark.parametrize("system", ["warp", "weft"])
def test_yarns_vary_by_what_was_asked(system: str) -> None:
    middle0, spread0 = _yarns(CLOTH, system)
    middle, spread = _yarns(uneven(unevenness=0.2), system)
    ratio = spread / spread0
    assert 0.1 < ratio.std() < 0.35
    # A yarn's middle scales with it: migration leaves it a little off the axis.
    assert np.abs(middle - middle0).max() < 0.3 * spread0.max()
    middle, spread = _yarns(uneven(waviness=0.5), system)
    half_width = YARN.radius * YARN.flattening
    assert 0.25 * half_width < (middle - middle0).std() < 0.9 * half_width
    assert spread == pytest.approx(spread0, rel=1e-9)


def test_the_patch_closes() -> None:
    for curves in generate_patch(uneven(unevenness=0.3, waviness=0.6), 16).systems:
        points, offsets = curves.extended(2, 3)
        for start, end in pairwise(offsets):
            steps = np.diff(points[start:end], axis=0)
            inside = np.abs(np.diff(steps[3:-3], axis=0)).max()
            assert np.abs(np.diff(steps, axis=0)).max() < 2.0 * inside + 1e-7


def test_variants_vary_inside_only() -> None:
    # Open enough that the inner yarns cannot reach the tile's sides.
    cloth = uneven(unevenness=0.15, waviness=0.3, radius=0.8e-4)
    first, second = patch_variants(cloth, 12, (2, 2), 2)
    for one, other in zip(first.systems, second.systems, strict=True):
        moved = np.abs(one.points - other.points).max(axis=1)
        axis = 0 if one.system == "weft" else 1
        along = one.points[:, axis] / one.period[axis]
        assert moved[(along < 0.02) | (along > 0.98)].max() == 0.0
        assert moved.max() > 0.3 * 0.8e-4


def test_torch_and_numpy_agree_and_gradients_match_finite_differences() -> None:
    torch = pytest.importorskip("torch")
    layout = lay_out(weave_from_name("twill 3/1"), "weft", 8)
    draws = draw(layout, 6, seed=5)
    shape = YarnShape.of(replace(YARN, unevenness=0.15, waviness=0.3, irregularity=0.2))
    successor = successors(shape, layout, draws)

    def offsets(values, xp):
        across, height = fiber_offsets(
            replace(shape, radius=1.0, unevenness=values[0], waviness=values[1]), layout, draws, successor, xp=xp
        )
        return xp.stack([across, height])

    values = torch.tensor([0.15, 0.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: offsets(v, torch), (values,), eps=1e-6, atol=1e-6)
    assert offsets(values.detach(), torch).numpy() == pytest.approx(offsets([0.15, 0.3], np), abs=1e-14)
