"""The number of fiber points is known beforehand, and repeats that do not fit are thinned or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import NAMED_WEAVES, FabricParameters, Weave, YarnParameters, preset
from usdfab.fibers import generate_patch, patch_points, patch_variants, thinned
from usdfab.fibers.budget import EASY_PATCH_POINTS, FEWEST_FIBERS, MAX_PATCH_POINTS


def jacquard(side: int, fibers: int, variants: int = 4) -> FabricParameters:
    """Every crossing bound as in plain weave, each end and pick of a colour of its own."""
    colors = tuple((k / side, 0.5, 0.5) for k in range(side))
    yarn = YarnParameters(count=side, fiber_count=fibers, yarn_albedo=colors)
    return FabricParameters(NAMED_WEAVES["plain"], (0.2, 0.2), yarn, yarn, variants=variants)


@given(
    st.sampled_from(sorted(NAMED_WEAVES)), st.integers(1, 6), st.integers(1, 4), st.integers(1, 3), st.integers(4, 9)
)
@settings(max_examples=30, deadline=None)
def test_points_are_counted_right(name: str, fibers: int, stripes: int, copies: int, vertices: int) -> None:
    yarn = YarnParameters(fiber_count=fibers, yarn_albedo=tuple((k / 5, 0.5, 0.5) for k in range(stripes)))
    fabric = FabricParameters(NAMED_WEAVES[name], warp=yarn, weft=replace(yarn, yarn_albedo=()))
    patch = generate_patch(fabric, vertices, (copies, 1))
    assert sum(len(s.points) for s in patch.systems) == patch_points(fabric, vertices, (copies, 1))


def test_presets_are_far_below_the_limit() -> None:
    fabric = preset("silk-satin")
    assert thinned(fabric) == (fabric, ())


def test_a_large_repeat_loses_variants_then_fibers() -> None:
    fewer, told = thinned(jacquard(60, 40))
    assert fewer.variants == 1 and fewer.warp.fiber_count == 40 and "variants are set to 1" in told[0]
    fabric = jacquard(100, 100)
    thin, told = thinned(fabric)
    assert thin.variants == 1 and FEWEST_FIBERS <= thin.warp.fiber_count < 100 and "fibers in each end" in told[0]
    assert patch_points(thin) <= EASY_PATCH_POINTS
    largest, _ = thinned(jacquard(200, 100))
    assert largest.warp.fiber_count == FEWEST_FIBERS and EASY_PATCH_POINTS < patch_points(largest) < MAX_PATCH_POINTS
    # The filled part of the cross-section stays, whether the radius is given or follows from it.
    for yarn in (YarnParameters(fiber_count=100), YarnParameters(fiber_count=100, fiber_radius=1e-5)):
        before = replace(fabric, warp=replace(fabric.warp, fiber_count=100, fiber_radius=yarn.fiber_radius))
        after, _ = thinned(before)
        area = [f.warp.fiber_count * f.warp.effective_fiber_radius**2 for f in (before, after)]
        assert area[0] == pytest.approx(area[1])


def test_what_does_not_fit_is_refused_before_anything_is_built() -> None:
    fabric = jacquard(512, 200)
    # Building it would take hours and 600 GB.
    with pytest.raises(UsdfabError, match=r"512 picks and 512 ends has 4.2e\+09 fiber points in 1 variants, above 3e"):
        generate_patch(fabric)
    with pytest.raises(UsdfabError, match=r"a lower both\.fiber_count"):
        patch_variants(fabric)
    with pytest.raises(UsdfabError, match="fiber points"):
        thinned(fabric)


def test_variants_that_do_not_fit_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    fabric = FabricParameters(Weave(np.eye(5, dtype=int), "x"), warp=YarnParameters(fiber_count=5), variants=4)
    fabric = replace(fabric, weft=fabric.warp)
    monkeypatch.setattr("usdfab.fibers.budget.MAX_PATCH_POINTS", int(2.5 * patch_points(fabric, 8)))
    assert len(patch_variants(fabric, 8)) == 2
