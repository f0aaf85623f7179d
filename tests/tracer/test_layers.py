"""AOVs: each layer against what is known of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane, swatch

from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.aovs import AOVS, aov_layers
from usdfab.tracer.patch_scene import tile_copies
from usdfab.usd.scene import DistantLight, PointLight, RectLight

SUN = DistantLight("/Sun", np.array([0.36, 0.48, -0.8]), np.full(3, 2.0), 0.0)
LAMP = RectLight(
    "/Rect", np.array([-0.05, -0.05, 0.3]), np.array([0.1, 0, 0]), np.array([0, 0.1, 0]), np.array([0.0, 0, -1]),
    np.full(3, 20.0),
)  # fmt: skip


def mixed(light):
    """Cloth beside a grey surface and a glowing one, below a pane."""
    glow = replace(lambert((0.2, 0.2, 0.2)), emissive=np.array([0.5, 0.3, 0.1]))
    pane = replace(lambert((0.3, 0.3, 0.3)), opacity=0.3)
    meshes = [plane(0.02, k, center=(0.02 * (k - 1), 0.0)) for k in range(3)] + [plane(0.1, 3, z=0.05)]
    return scenes.scene(meshes, [cloth_material(), lambert(), glow, pane], [light], [fabric()])


@pytest.mark.parametrize("light", [SUN, LAMP, dome()], ids=["sun", "rect", "dome"])
def test_direct_light_is_what_depth_two_shows(light):
    tracer = Tracer(mixed(light))
    camera = look((0, 0, 0.2), (0, 0, 0), (0.16, 0.16))
    deep, shallow = (tracer.render(camera, RenderSettings((32, 32), spp=8, max_depth=d)) for d in (16, 2))
    np.testing.assert_allclose(deep.direct, shallow.pixels, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(shallow.direct, shallow.pixels, rtol=1e-6)
    layers = aov_layers(deep, list(AOVS))
    np.testing.assert_allclose(layers["direct"] + layers["indirect"], deep.pixels, rtol=1e-5, atol=1e-6)
    assert layers["indirect"].min() > -1e-5 and layers["indirect"].max() > 0.01


def test_exposure_scales_direct_light_too():
    tracer = Tracer(mixed(SUN))
    camera = look((0, 0, 0.2), (0, 0, 0), (0.16, 0.16))
    settings = RenderSettings((16, 16), spp=2, max_depth=8)
    one, two = (tracer.render(replace(camera, exposure=e), settings) for e in (0.0, 1.5))
    np.testing.assert_allclose(two.direct, one.direct * 2**1.5, rtol=1e-5)
    np.testing.assert_array_equal(two.albedo, one.albedo)


def test_uv_and_depth_of_a_tilted_plane():
    """Against the plane's equation at the middles of the pixels."""
    scene = scenes.scene([plane(2.0)], [lambert()], [dome()])
    eye = np.array([0.1, -0.4, 0.5])
    camera = look(eye, (0, 0, 0), (0.3, 0.3))
    render = Tracer(scene).render(camera, RenderSettings((64, 64), spp=64, max_depth=1))
    s = 2 * (np.arange(64) + 0.5) / 64 - 1
    local = np.stack([*np.meshgrid(0.3 * s, -0.3 * s), -np.ones((64, 64))], axis=-1)
    direction = local @ camera.to_world[:3, :3].T
    t = -eye[2] / direction[..., 2]
    place = eye + t[..., None] * direction
    np.testing.assert_allclose(render.uv, place[..., :2], atol=2e-3)
    np.testing.assert_allclose(render.depth, t * np.linalg.norm(direction, axis=-1), rtol=3e-3)


def test_uv_of_cloth_is_where_the_ray_meets_the_mesh():
    """In units of the mesh's uv, not of the cloth."""
    scene = scenes.scene([plane(0.1)], [cloth_material()], [dome()], [fabric()])
    surface = replace(scene.fabrics[0], meters_per_uv=0.25)
    mesh = scene.meshes[0]
    scene = replace(scene, fabrics=(surface,), meshes=(replace(mesh, uv=mesh.uv / 0.25),))
    camera = look((0, 0, 0.2), (0, 0, 0), (0.05, 0.05))
    render = Tracer(scene).render(camera, RenderSettings((32, 32), spp=64, max_depth=1))
    x, y = np.meshgrid(*2 * [0.01 * (2 * (np.arange(32) + 0.5) / 32 - 1)])
    covered = render.alpha > 0.9
    assert covered.mean() > 0.3
    expected = np.stack([x, -y], axis=-1) / 0.25
    np.testing.assert_allclose(render.uv[covered], expected[covered], atol=6e-4)
    assert np.abs(render.depth[covered] - 0.2).max() < 2e-3
    # The same fibers as with uv in metres.
    plain = scenes.scene([plane(0.1)], [cloth_material()], [dome()], [fabric()])
    other = Tracer(plain).render(camera, RenderSettings((32, 32), spp=64, max_depth=1))
    assert np.mean(other.fiber_id == render.fiber_id) > 0.99


def test_depth_of_lights_and_of_things_behind_panes():
    light = replace(LAMP, normal=np.array([0.0, 0, 1]))
    scene = scenes.scene([plane(4.0)], [lambert()], [light])
    camera = look((0, 0, 1.0), (0, 0, 0), (1e-3, 1e-3))
    seen = Tracer(scene).render(camera, RenderSettings((4, 4), spp=4, max_depth=2))
    np.testing.assert_allclose(seen.alpha, 1.0)
    np.testing.assert_allclose(seen.depth, 0.7, rtol=1e-5)
    clear = replace(lambert(), opacity=0.0)
    scene = scenes.scene([plane(4.0), plane(1.0, 1, z=0.4)], [lambert(), clear], [dome()])
    seen = Tracer(scene).render(camera, RenderSettings((4, 4), spp=4, max_depth=2))
    np.testing.assert_allclose(seen.depth, 1.0, rtol=1e-5)


def test_ids_of_fibers_and_yarns():
    """Ids belong to the patch's curves; along a yarn the id stays; each fiber belongs to one yarn."""
    cloth = fabric("twill 2/2", fibers=5)
    patch = generate_patch(cloth, copies=tile_copies(cloth))
    curves = sum(system.curves for system in patch.curves)
    yarns = int(patch.warp.yarn.max()) + 1 + int(patch.weft.yarn.max()) + 1
    scene = scenes.scene([plane(0.1)], [cloth_material()], [dome()], [cloth])
    tracer = Tracer(scene)
    side = patch.size[0]
    camera = look((side / 2, side / 2, 1.0), (side / 2, side / 2, 0), (side / 2, side / 2))
    render = tracer.render(camera, RenderSettings((160, 160), spp=1, max_depth=1))
    assert render.fiber_id.min() >= 0 and render.fiber_id.max() <= curves
    assert render.yarn_id.min() >= 0 and render.yarn_id.max() <= yarns
    assert set(np.unique(render.yarn_id)) - {0} == set(range(1, yarns + 1))
    np.testing.assert_array_equal(render.fiber_id > 0, render.yarn_id > 0)
    np.testing.assert_array_equal(render.fiber_id > 0, render.alpha > 0)
    pairs = np.unique(np.stack([render.fiber_id.ravel(), render.yarn_id.ravel()]), axis=1)
    assert len(np.unique(pairs[0])) == pairs.shape[1]
    # Warp yarns stand at one x, weft yarns at one y.
    warp = int(patch.warp.yarn.max()) + 1
    row, column = np.indices(render.yarn_id.shape)
    pitch = 160 / warp
    for yarn in range(1, yarns + 1):
        place = (column if yarn <= warp else row)[render.yarn_id == yarn]
        # Around the tile: the middle of a yarn may lie on its border.
        angle = 2 * math.pi * (place + 0.5) / 160
        off = np.angle(np.exp(1j * (angle - np.angle(np.exp(1j * angle).mean())))) * 160 / (2 * math.pi)
        assert np.abs(off).max() < pitch
    # Which system is on top follows the weave.
    top = np.where(render.yarn_id == 0, -1, (render.yarn_id > warp).astype(int))
    assert 0.3 < (top == 1).sum() / (top >= 0).sum() < 0.7


def test_ids_are_zero_off_the_cloth():
    render = Tracer(mixed(SUN)).render(look((0, 0, 0.2), (0, 0, 0), (0.16, 0.16)), RenderSettings((32, 32), spp=1))
    assert not render.fiber_id[:, 16:].any() and not render.yarn_id[:, 16:].any()
    assert render.fiber_id[10:22, :8].any()


def test_ids_belong_to_their_own_patch():
    """With two fabrics, ids and yarns of the second start anew."""
    one, two = fabric(fibers=7), fabric("twill 2/2", fibers=3)
    scene = scenes.scene(
        [plane(0.01, 0, center=(-0.005, 0)), plane(0.01, 1, center=(0.005, 0))],
        [cloth_material(0), cloth_material(1)], [dome()], [one, two],
    )  # fmt: skip
    render = Tracer(scene).render(look((0, 0, 0.1), (0, 0, 0), (0.1, 0.05)), RenderSettings((96, 48), spp=1))
    for half, cloth in ((render.fiber_id[:, :46], one), (render.fiber_id[:, 50:], two)):
        patch = generate_patch(cloth, copies=tile_copies(cloth))
        count = sum(s.curves for s in patch.curves)
        assert 0.5 * count < half.max() <= count


def test_samples_and_normals():
    scene, camera = swatch(fabric(), PointLight("/P", np.array([0, 0, 0.2]), np.ones(3)))
    render = Tracer(scene).render(camera, RenderSettings((16, 16), spp=7))
    np.testing.assert_array_equal(render.samples, 7)
    assert render.spp == 7
    covered = render.alpha == 1.0
    np.testing.assert_allclose(np.linalg.norm(render.normal[covered], axis=-1), 1.0, atol=1e-5)
    assert (render.normal[covered][:, 2] > -0.2).mean() > 0.95
