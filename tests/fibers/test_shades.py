"""Fibers of one yarn that differ in albedo: how much, and that none changes its colour over the patch's border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fabric.optics import optics_of
from usdfab.fibers import generate_patch
from usdfab.fibers.shades import LEVELS, drawn_shades, shaded_albedo
from usdfab.tracer.patch_scene import build_patch_scene

YARN = YarnParameters(
    count=4, radius=1.2e-4, fiber_count=24, twist=0.17, albedo=(0.2, 0.5, 0.7), albedo_variation=0.5,
    flyaway_density=3000.0,
)  # fmt: skip
CLOTH = FabricParameters(weave_from_name("twill 2/2"), (2e-3, 2e-3), YARN, replace(YARN, albedo=(0.6, 0.1, 0.3)))


def plied(plies: int) -> FabricParameters:
    return replace(CLOTH, warp=replace(YARN, ply_count=plies), weft=replace(CLOTH.weft, ply_count=plies))


def test_levels_are_those_of_a_normal_distribution() -> None:
    assert np.mean(LEVELS) == pytest.approx(0.0, abs=1e-12)
    assert np.std(LEVELS) == pytest.approx(1.0, abs=1e-3)
    quarters = np.sort(np.random.default_rng(0).normal(size=400_000)).reshape(4, -1).mean(axis=1)
    assert np.asarray(LEVELS) == pytest.approx(quarters / quarters.std(), abs=0.01)


@given(seed=st.integers(0, 2**32 - 1), plies=st.integers(1, 4), each=st.integers(4, 9))
def test_plies_have_equally_many_fibers_of_each_shade(seed: int, plies: int, each: int) -> None:
    shade = drawn_shades(np.random.default_rng(seed).uniform(size=(3, plies * each)), plies)
    counts = np.stack(
        [[np.bincount(yarn[p::plies], minlength=len(LEVELS)) for p in range(plies)] for yarn in shade]
    )  # fmt: skip
    assert np.all(counts == counts[0, 0])
    assert counts.max() - counts.min() <= 1


def test_the_root_of_absorption_varies_by_a_factor() -> None:
    color = np.array([[0.2, 0.5, 0.99]])
    shades = np.concatenate([shaded_albedo(color, 0.4, np.array([k])) for k in range(len(LEVELS))])
    ratio = np.log(shades) / np.log(color)
    assert np.log(ratio) == pytest.approx(0.4 * np.asarray(LEVELS)[:, None] * np.ones(3))
    assert np.array_equal(shaded_albedo(color, 0.0, np.array([0])), color)


@pytest.mark.parametrize("plies", [1, 2, 3])
def test_fibers_keep_their_colour_over_the_border(plies: int) -> None:
    patch = generate_patch(plied(plies), vertices_per_segment=6)
    for system in patch.systems:
        assert np.array_equal(system.albedo[system.successor], system.albedo)
        assert len(np.unique(system.albedo, axis=0)) == len(LEVELS)
        # The yarn's ends meet there too: no fiber jumps by more than a yarn's width.
        points, offsets = system.extended(0, 1)
        last, after = points[offsets[1:] - 2], points[offsets[1:] - 1]
        spacing = np.linalg.norm(np.diff(system.points[:6], axis=0), axis=1).mean()
        assert np.linalg.norm(after - last, axis=1).max() < 2.0 * spacing
    assert all(len(np.unique(f.albedo, axis=0)) <= len(LEVELS) for f in patch.flyaways)


def test_shades_do_not_move_fibers_of_one_albedo() -> None:
    one = replace(CLOTH, warp=replace(YARN, albedo_variation=0.0))
    patch, varied = (generate_patch(c, vertices_per_segment=6) for c in (one, CLOTH))
    assert np.array_equal(patch.warp.albedo, np.broadcast_to(YARN.albedo, patch.warp.albedo.shape))
    assert np.array_equal(patch.weft.points, varied.weft.points)


def test_each_shade_is_a_material_of_the_tracer() -> None:
    scene = build_patch_scene(CLOTH)
    # Warp and weft, yarns and flyaways.
    assert len(scene.materials) == 4 * len(LEVELS)
    whole = shaded_albedo(np.tile(YARN.albedo, (4, 1)), 0.5, np.arange(4))
    assert np.sort(scene.albedo[:4, 0]) == pytest.approx(np.sort(whole[:, 0]))


def test_gradients_say_that_they_know_one_albedo_only() -> None:
    with pytest.raises(UsdfabError, match="one albedo for all fibers"):
        optics_of(CLOTH)
