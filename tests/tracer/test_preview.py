"""The picture that is shown while kernels are compiled, against the kernels."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane, swatch
from test_embree import shoot

from usdfab.fabric import System
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import build_patch_scene
from usdfab.tracer.preview import BRIGHTNESS, preview, trace


@pytest.mark.parametrize("count", [1, 16, 1000])
def test_packets_meet_what_single_rays_meet(count):
    tile = build_patch_scene(fabric(fibers=12))
    rng = np.random.default_rng(count)
    place = np.c_[rng.uniform(0, 1, (count, 2)) * tile.size, np.full(count, tile.z_range[1])]
    slope = np.c_[rng.uniform(-0.7, 0.7, (count, 2)), np.full(count, -1.0)]
    direction = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    one, many = shoot(tile.scene, place, direction), trace(tile.scene.handle, place, direction, np.full(count, 1e30))
    assert np.array_equal(one.hit, many.hit)
    assert (one.prim != many.prim)[one.hit].sum() <= count // 1000
    np.testing.assert_allclose(many.t[one.hit], one.t[one.hit], rtol=1e-4)
    ends = np.where(one.hit, 0.5 * one.t, 0.1)
    assert not trace(tile.scene.handle, place, direction, ends).hit.any()


def test_cloth_shows_the_fibers_that_the_render_shows():
    """Warp red, weft green: the same yarns in the same places, at an angle, and the same gaps."""
    cloth = fabric("twill_1_3", fibers=20)
    colors: dict[System, tuple[float, float, float]] = {"warp": (0.8, 0.0, 0.0), "weft": (0.0, 0.8, 0.0)}
    cloth = cloth.with_systems({name: replace(cloth.system(name), albedo=color) for name, color in colors.items()})
    scene, camera = swatch(cloth)
    side = 96
    seen = preview(Tracer(scene), camera, side, side)
    render = Tracer(scene).render(camera, RenderSettings((side, side), spp=16, max_depth=1))
    assert 0.0 < seen.max() <= BRIGHTNESS
    assert abs((seen.max(axis=2) > 0.0).mean() - render.alpha.mean()) < 0.02
    clear = (render.albedo.min(axis=2) < 0.01) & (render.albedo.max(axis=2) > 0.79) & (seen.max(axis=2) > 0.0)
    assert clear.mean() > 0.5
    assert np.mean((seen.argmax(axis=2) == render.albedo.argmax(axis=2))[clear]) > 0.97


def test_surfaces_are_lit_from_the_camera():
    camera = look(np.array([0.0, 0.0, 1.0]), np.zeros(3), (0.05, 0.05))
    tracer = Tracer(scenes.scene([plane(0.04)], [lambert((0.5, 0.25, 0.125))], [dome()]))
    seen = preview(tracer, camera, 40, 20)
    np.testing.assert_allclose(seen[10, 20], BRIGHTNESS * np.array([0.5, 0.25, 0.125]), rtol=1e-3)
    assert seen[0, 0].max() == 0.0  # past the plane
    assert abs((seen.max(axis=2) > 0.0).mean() - 0.16) < 0.01


def test_copies_are_shown_where_they_are():
    camera = look(np.array([0.0, 0.0, 1.0]), np.zeros(3), (0.05, 0.05))
    turned = np.array([[0.0, -1.0, 0.0, 0.02], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    tilted = np.array([[0.5, 0.0, 0.0, -0.02], [0.0, 1.0, 0.0, 0.0], [np.sqrt(0.75), 0.0, 1.0, 0.0]])
    mesh = replace(plane(0.02), placements=np.stack([turned, tilted]))
    for material, cloth in ((lambert((0.4, 0.4, 0.4)), []), (cloth_material(), [fabric(albedo=(0.4, 0.4, 0.4))])):
        seen = preview(Tracer(scenes.scene([mesh], [material], [dome()], cloth)), camera, 50, 50)[..., 0]
        assert abs(seen[25, 35] / (0.4 * BRIGHTNESS) - 1.0) < 2e-3
        assert abs(seen[25, 15] / (0.4 * BRIGHTNESS) - 0.5) < 0.02
        assert seen[25, 25] == 0.0


def test_no_kernel_is_compiled_for_it():
    """A fresh process, in which nothing has been compiled: what Numba compiles or loads would be told."""
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from numba.core import event\n"
        "from scenes import fabric, swatch\n"
        "from usdfab.tracer import Tracer\n"
        "from usdfab.tracer.preview import preview\n"
        "scene, camera = swatch(fabric(fibers=4))\n"
        "tracer = Tracer(scene)\n"
        "with event.install_recorder('numba:compile') as told:\n"
        "    assert preview(tracer, camera, 16, 16).max() > 0.0\n"
        "assert not told.buffer\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
