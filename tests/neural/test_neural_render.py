"""The neural renderer on scenes with known answers: the surface model itself stands in for the network."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path += [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tracer")]

from neural_examples import lively
from numba import njit
from numpy.typing import NDArray
from scenes import cloth_material, dome, fabric, lambert, look, plane, scene

from usdfab.errors import UsdfabError
from usdfab.neural.aggregation import aggregate
from usdfab.neural.gbuffer import NUMBERS, PLACE, SIZE, VIEW, pixel_footprint
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.render import Buffer, places_of, render, see
from usdfab.neural.rendered_material import learned_material, reversed_material
from usdfab.neural.simd import LANES, load, store
from usdfab.neural.stage_scene import NeuralScene, build, mip_levels
from usdfab.neural.surface_from_fabric import surface_from_fabric
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.tracer.render import pack_view
from usdfab.usd.scene import Camera, DistantLight, PointLight, Scene, Texture

CLOTH = fabric("twill 2/1")
NETWORKS = {kind: Weights(lively("lean", kind), {}) for kind in KINDS}
ABOVE = PointLight("/Lamp", np.array([0.02, 0.01, 0.05]), np.full(3, 2e-3))
SIZE_PX = (6, 4)


class Surface:
    """Answers as the surface model does."""

    def __init__(self, material: SurfaceMaterial, transmission: bool) -> None:
        self.material, self.transmission = material, transmission

    def decode(self, queries: NDArray) -> NDArray:
        # One by one: the same samples in whichever order the pixels come.
        ask = partial(aggregate, self.material, transmission=self.transmission, samples=256, threads=1)
        return np.concatenate([ask(query[None]) for query in queries])


def ready(world: Scene) -> NeuralScene:
    """The scene with the surface model in the network's place."""
    made = build(world, NETWORKS, {})
    plans: list = []
    for surface in world.fabrics:
        material = learned_material(surface_from_fabric(surface.fabric)[0])[0]
        plans += [Surface(m, t) for m in (material, reversed_material(material)) for t in (False, True)]
    return replace(made, plans=plans, decoders=None)


def on_cloth(*lights, meshes=(), materials=()) -> Scene:
    return scene([plane(0.04), *meshes], [cloth_material(), *materials], lights, [CLOTH])


def draw(world: Scene, camera: Camera, **more) -> NDArray[np.float64]:
    found = render(ready(world), camera, SIZE_PX, (0, 0, *SIZE_PX), **more)
    return found.pixels.astype(float)


def rays(camera: Camera) -> tuple[NDArray, NDArray]:
    """Origin (3,) and unit directions (h, w, 3) through the pixels' middles, from the camera's documentation."""
    width, height = SIZE_PX
    s = 2 * (np.arange(width) + 0.5) / width - 1
    t = 1 - 2 * (np.arange(height) + 0.5) / height
    local = np.stack(
        np.broadcast_arrays(camera.tan_half[0] * s[None, :], camera.tan_half[1] * t[:, None], -1.0), axis=-1
    )
    directions = local @ camera.to_world[:3, :3].T
    return camera.to_world[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def brute_force(camera: Camera, light: PointLight, *, below: bool = False) -> NDArray[np.float64]:
    """The cloth's radiance with no renderer: where each ray meets z = 0, and what the surface model says there."""
    material, colors = surface_from_fabric(CLOTH)
    material, cover = learned_material(material)
    origin, directions = rays(camera)
    back = origin[2] < 0
    points = origin - directions * (origin[2] / directions[..., 2:])
    tile = np.array([CLOTH.cell[0] * 3, CLOTH.cell[1] * 3])
    place = (points[..., :2] / tile) % 1.0
    to_light = light.position - points
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    incoming, outgoing = to_light / distance, -directions
    # The neighbours' rays on the plane.
    width, height = SIZE_PX
    steps = []
    for axis, span in ((0, 2 / width), (1, -2 / height)):
        shift = camera.to_world[:3, axis] * camera.tan_half[axis] * span
        scale = np.linalg.norm((camera.to_world[:3, :3].T @ directions[..., None])[..., 2:, 0:], axis=-2)
        moved = directions / scale + shift
        steps.append(((origin - moved * (origin[2] / moved[..., 2:])) - points)[..., :2] / tile)
    across = np.linalg.svd(np.stack(steps, axis=-1), compute_uv=False)
    size = np.maximum(np.sqrt(across.prod(axis=-1)), across[..., 0] / 2)
    # From half a tile on a pixel is filtered over twice its footprint.
    size = np.where(size < 0.5, size + 2 * size**2, 2 * size)
    if back:
        material = reversed_material(material)
        place = np.stack([1 - place[..., 0], place[..., 1]], axis=-1)
        incoming, outgoing = incoming * [-1, 1, -1], outgoing * [-1, 1, -1]
    lit_from_behind = incoming[0, 0, 2] < 0
    assert lit_from_behind == below
    queries = np.concatenate([place, size[..., None], incoming, outgoing[..., :2]], axis=-1).reshape(-1, 8)
    answers = Surface(material, below).decode(queries)
    colors_here = colors.transmission if below else colors.reflection
    radiance = cover * (answers @ colors_here).reshape(*points.shape)
    return radiance * light.intensity / distance**2


@pytest.mark.parametrize(
    ("eye", "light", "below"),
    [
        ((0.01, -0.03, 0.06), (0.02, 0.01, 0.05), False),
        ((0.0, 0.002, 0.02), (-0.02, 0.03, -0.05), True),
        ((0.01, 0.02, -0.04), (0.0, -0.01, -0.05), False),
        ((0.01, 0.02, -0.04), (0.03, -0.01, 0.05), True),
    ],
)
def test_cloth_is_what_the_surface_model_says(eye: tuple, light: tuple, below: bool) -> None:
    """Seen and lit from the front and from behind."""
    camera, lamp = look(eye, (0, 0, 0), (0.15, 0.1)), replace(ABOVE, position=np.asarray(light))
    found, expected = draw(on_cloth(lamp), camera), brute_force(camera, lamp, below=below)
    assert expected.min() >= 0 and expected.max() > 1e-3 and np.ptp(expected) > 0.05 * expected.max()
    # Footprints agree to rounding; a sample on a yarn's border may fall to either side.
    assert np.allclose(found, expected, rtol=0.02, atol=0.01 * expected.max())


def test_footprints_on_a_plane_are_those_of_perspective() -> None:
    camera = look((0, 0, 0.05), (0, 0, 0), (0.03, 0.02))
    found = buffer(camera)
    pixel = 0.05 * 2 * 0.03 / 6
    assert np.allclose(found[:, SIZE], pixel / (3 * CLOTH.cell[0]), rtol=1e-6)
    assert np.allclose(found[:, VIEW + 2] ** 2 + (found[:, VIEW : VIEW + 2] ** 2).sum(axis=1), 1)
    origin, directions = rays(camera)
    points = (origin - directions * (origin[2] / directions[..., 2:])).reshape(-1, 3)
    place = (points[:, :2] / (3 * CLOTH.cell[0])) % 1
    assert np.allclose(found[:, PLACE : PLACE + 2], place, atol=1e-4)
    # Tilted by 60 degrees: twice as long as wide; as large as the ellipse.
    tilted = look((0, -0.05 * math.sin(math.pi / 3), 0.025), (0, 0, 0), (3e-4, 2e-4))
    sides = buffer(tilted)[:, SIZE] * 3 * CLOTH.cell[0]
    assert np.allclose(sides, 0.05 * 2 * 3e-4 / 6 * math.sqrt(2), rtol=0.01)


def buffer(camera: Camera) -> NDArray[np.float64]:
    """The numbers (pixels, NUMBERS) of a picture, row by row."""
    made = ready(on_cloth(ABOVE))
    _tags, numbers, _seen = see(made, pack_view(camera, *SIZE_PX, False), 1, 0, (0, 0, *SIZE_PX))
    # Tiles of 4 x 4: one row of two, the second half empty.
    width, height = SIZE_PX
    tiles = numbers.reshape(NUMBERS, 1, 2, 4, 4).transpose(1, 3, 2, 4, 0).reshape(4, 8, NUMBERS)
    return tiles[:height, :width].reshape(-1, NUMBERS).astype(float)


@njit
def sides(matrices, out):
    out[:] = 0.0
    store(
        out, 0,
        pixel_footprint(load(matrices, 0), load(matrices, LANES), load(matrices, 2 * LANES), load(matrices, 3 * LANES)),
    )  # fmt: skip


def test_footprint_of_a_parallelogram() -> None:
    matrices = np.random.default_rng(0).normal(size=(4, LANES)).astype(np.float32)
    out = np.zeros(LANES, dtype=np.float32)
    sides(matrices.ravel(), out)
    for (a, b, c, d), side in zip(matrices.T.astype(float), out, strict=True):
        long, short = np.linalg.svd(np.array([[a, c], [b, d]]), compute_uv=False)
        assert side == pytest.approx(max(math.sqrt(long * short), long / 2))


def test_cloth_and_other_surfaces_throw_shadows_on_each_other() -> None:
    camera = look((0.0, 0.0, 0.06), (0, 0, 0), (0.15, 0.1))
    middle = np.array([0.0102, 0.005])  # no pixel lies on the shadow's border
    card = plane(0.005, material=1, z=0.02, center=tuple(middle))
    world = on_cloth(ABOVE, meshes=[card], materials=[lambert()])
    lit, dark = draw(on_cloth(ABOVE), camera), draw(world, camera)
    shadow = (dark < 1e-9).all(axis=-1)
    assert 0 < shadow.sum() < shadow.size
    # The card's shadow on z = 0, thrown by the lamp, and the card itself, which is lit.
    origin, directions = rays(camera)
    points = origin - directions * (origin[2] / directions[..., 2:])
    to_card = points + (ABOVE.position - points) * (0.02 / ABOVE.position[2])
    hidden = (np.abs(to_card[..., :2] - middle) < 0.0025).all(axis=-1)
    seen = points * (0.04 / 0.06)
    on_card = (np.abs(seen[..., :2] - middle) < 0.0025).all(axis=-1)
    assert np.array_equal(shadow, hidden & ~on_card)
    # The surface model's samples depend on how many pixels are asked about together.
    assert np.allclose(dark[~hidden & ~on_card], lit[~hidden & ~on_card], rtol=0.15)


def test_diffuse_surfaces_follow_lambert() -> None:
    camera = look((0, 0, 0.06), (0, 0, 0), (0.15, 0.1))
    sun = DistantLight("/Sun", np.array([0.6, 0.0, -0.8]), np.full(3, 2.0), 0.0)
    world = scene([plane(0.04)], [lambert((0.5, 0.25, 1.0))], [sun])
    found = render(build(world, {}, {}), camera, SIZE_PX, (0, 0, *SIZE_PX)).pixels
    # UsdPreviewSurface reflects a few percent at its surface, too.
    assert np.allclose(found, 2.0 * 0.8 / math.pi * np.array([0.5, 0.25, 1.0]), rtol=0.12)
    # Under a dome a white surface is as bright as the sky, and the sky is seen beside it.
    white = scene([plane(0.004)], [lambert((1.0, 1.0, 1.0))], [dome(0.7)])
    found = render(build(white, {}, {}), camera, SIZE_PX, (0, 0, *SIZE_PX), spp=8).pixels
    assert np.allclose(found[0, 0], 0.7) and 0.5 < found[1:3, 2:4].mean() / 0.7 < 1.05


def test_threads_and_regions_do_not_change_the_picture() -> None:
    made = build(on_cloth(ABOVE, dome(0.2)), NETWORKS, {})
    camera = look((0.01, -0.03, 0.05), (0, 0, 0), (0.2, 0.2))
    whole = render(made, camera, (40, 40), (0, 0, 40, 40), spp=2, threads=1)
    assert np.array_equal(render(made, camera, (40, 40), (0, 0, 40, 40), spp=2, threads=3).pixels, whole.pixels)
    part = render(made, camera, (40, 40), (7, 20, 33, 39), spp=2)
    assert np.allclose(part.pixels, whole.pixels[20:39, 7:33], rtol=1e-5)
    assert whole.decodes > 0 and np.isfinite(whole.pixels).all()


def test_a_kept_buffer_gives_the_same_picture_and_follows_lights_and_materials() -> None:
    camera = look((0.01, -0.03, 0.05), (0, 0, 0), (0.2, 0.2))
    whole, kept = ((40, 24), (0, 0, 40, 24)), Buffer()
    first, other = build(on_cloth(ABOVE), NETWORKS, {}), build(on_cloth(dome(0.2)), NETWORKS, {})
    assert np.array_equal(render(first, camera, *whole, buffer=kept).pixels, render(first, camera, *whole).pixels)
    assert len(kept.strips) == 3
    moved = replace(first, lights=other.lights)
    assert np.array_equal(render(moved, camera, *whole, buffer=kept).pixels, render(moved, camera, *whole).pixels)
    dyed = replace(first, albedo=first.albedo * np.float32(0.5))
    half = render(dyed, camera, *whole, buffer=kept).pixels
    assert np.allclose(half, 0.5 * render(first, camera, *whole).pixels, rtol=1e-5)


def test_places_on_lights_go_on_from_sample_to_sample() -> None:
    many = np.concatenate([places_of(k, 4) for k in range(64)])
    assert len(np.unique(many.round(9), axis=0)) == 256
    cells = np.histogram2d(*many.T, bins=8, range=[[0, 1], [0, 1]])[0]
    assert cells.min() >= 2 and cells.max() <= 6
    assert np.array_equal(places_of(0, 1), [[0.5, 0.5]])


def test_prints_are_averaged_over_footprints() -> None:
    rng = np.random.default_rng(1)
    image = rng.random((16, 32, 3)).astype(np.float32)
    texture = Texture("print", "rgb", ("repeat", "repeat"), True, np.ones(4), np.zeros(4), np.eye(2, 3))
    levels = mip_levels(texture, {"print": image})
    assert [texels.shape[:2] for _, texels in levels] == [(16, 32), (8, 16), (4, 8), (2, 4), (1, 2), (1, 1)]
    for _, texels in levels:
        assert np.allclose(texels.mean(axis=(0, 1)), image.mean(axis=(0, 1)), atol=1e-6)
    coded = mip_levels(replace(texture, linear=False), {"print": np.full((4, 4, 3), 0.5, dtype=np.float32)})
    assert np.allclose(coded[-1][1], 0.21404, atol=1e-4) and coded[-1][0].linear


def test_stages_that_cannot_be_drawn() -> None:
    naked = replace(plane(0.04), uv=None)
    with pytest.raises(UsdfabError, match="/Plane: the cloth has no texture coordinates"):
        build(scene([naked], [cloth_material()], [ABOVE], [CLOTH]), NETWORKS, {})
    rows = "/".join("1" * k + "0" + "1" * (16 - k) for k in range(17))
    large = replace(CLOTH, weave=fabric(rows).weave)
    with pytest.raises(UsdfabError, match="17 ends and 17 picks is larger than the encoder takes"):
        build(scene([plane(0.04)], [cloth_material()], [ABOVE], [large]), NETWORKS, {})
    with pytest.raises(UsdfabError, match="no light"):
        build(on_cloth(), NETWORKS, {})
    glowing = replace(lambert(), emissive=np.ones(3))
    world = on_cloth(ABOVE, meshes=[plane(0.01, 1, 0.01)], materials=[glowing])
    assert build(world, NETWORKS, {}).warnings == (
        "/Lambert: a surface that glows lights nothing in the neural backend",
    )
    with pytest.raises(UsdfabError, match="/Lambert"):
        build(world, NETWORKS, {}, strict=True)
