"""No light is lost or made: closed rooms and white furnaces with cloth of all shapes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane

from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import Mesh

SLOW = pytest.mark.slow
WHITE = fabric(albedo=(1, 1, 1))
OTHER = fabric("twill 2/2", albedo=(1, 1, 1), radius=1.7e-4, roughness_azimuthal=0.3)


def check(scene, camera, spp, mask=None, side=24, error_limit=2.5e-3):
    """Radiance 1 within 0.5 % and within the noise, over the masked pixels."""
    render = Tracer(scene).render(camera, RenderSettings((side, side), spp=spp, max_depth=4000))
    assert np.isfinite(render.pixels).all()
    mask = np.ones(render.alpha.shape, dtype=bool) if mask is None else mask(render)
    assert mask.mean() > 0.1
    mean = render.pixels[mask].mean(axis=0, dtype=float)
    error = np.sqrt(render.variance[mask].sum(axis=0)) / mask.sum()
    assert error.max() < error_limit, f"too noisy to tell: {error}"
    assert np.all(abs(mean - 1.0) < np.minimum(4 * error + 1e-4, 5e-3)), f"{mean} +- {error}"
    return render


def room(side: float, material: int) -> Mesh:
    """A closed box about the origin."""
    corners = side / 2 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)
    return replace(
        plane(1.0), points=corners, triangles=triangles, uv=None, face_material=np.full(12, material, dtype=np.int32)
    )


def ball(radius: float = 0.02) -> Mesh:
    """Nearly all of a sphere, with cloth of varying size around it."""

    def point(a, b):
        around, polar = 2 * math.pi * a, math.pi * (0.98 * b + 0.01)
        ring = np.sin(polar)
        return radius * np.stack([ring * np.cos(around), ring * np.sin(around), -np.cos(polar)], axis=-1)

    return scenes.sheet(point, lambda a, b: np.stack([6 * radius * a, 3 * radius * b], axis=-1), 32, 16)


def waves(height: float = 4e-3) -> Mesh:
    """A drape: narrow folds whose normals turn fast, much coarser triangles than yarns."""

    def point(a, b):
        x, y = 0.06 * a - 0.03, 0.06 * b - 0.03
        return np.stack([x, y, height * np.sin(700.0 * x) * np.cos(150.0 * y)], axis=-1)

    return scenes.sheet(point, lambda a, b: np.stack([0.09 * a, 0.07 * b], axis=-1), 48, 24)


def test_cloth_in_a_closed_glowing_room():
    """Walls of albedo a that emit 1 - a: radiance 1 everywhere, on white cloth that hangs in it too."""
    albedo = np.array([0.5, 0.6, 0.2])
    wall = replace(lambert(albedo), emissive=1.0 - albedo)
    scene = scenes.scene([room(2.0, 0), plane(0.5, 1)], [wall, cloth_material()], [], [WHITE])
    check(scene, look((0.1, 0.2, 0.5), (0, 0, 0), (0.6, 0.6)), 400)


def test_nearly_white_room_with_a_lamp():
    """A white room in which one wall's square glows: it is the light, and light is sampled by the others only.

    White walls and cloth keep all light; the square of albedo 0.5 that emits 0.5 takes half of what comes: radiance 1.
    """
    glow = replace(lambert((0.5, 0.5, 0.5)), emissive=np.full(3, 0.5))
    white = replace(lambert((1.0, 1.0, 1.0)))
    walls = room(1.0, 1)
    faces = walls.face_material.copy()
    faces[:4] = 0
    meshes = [replace(walls, face_material=faces), replace(plane(0.3, 2), points=plane(0.3).points[:, [0, 2, 1]])]
    scene = scenes.scene(meshes, [glow, white, cloth_material()], [], [WHITE])
    check(scene, look((0.1, 0.4, 0.1), (0, 0, 0), (0.4, 0.4)), 300)


CURVED = [
    ("ball", 600),
    pytest.param("ball", 2400, marks=SLOW),
    ("waves", 500),
    pytest.param("waves", 2000, marks=SLOW),
]


@pytest.mark.parametrize("eye", [(0.01, -0.05, 0.1), (0.0, 0.1, -0.04)])
@pytest.mark.parametrize(("shape", "spp"), CURVED)
def test_furnace_on_curved_cloth(shape, spp, eye):
    """Light that gets into the ball comes out after very many bounces: more noise."""
    mesh = ball() if shape == "ball" else waves()
    scene = scenes.scene([mesh], [cloth_material()], [dome()], [WHITE])
    check(scene, look(eye, (0, 0, 0), (0.25, 0.25)), spp, lambda r: r.alpha > 0.5, error_limit=5e-3)


@pytest.mark.parametrize("degrees", [30, 85])
def test_furnace_at_the_edge_of_the_cloth(degrees):
    """The outermost millimetre of a square of cloth, from above and along it."""
    angle = math.radians(degrees)
    scene = scenes.scene([plane(0.02)], [cloth_material()], [dome()], [WHITE])
    eye = np.array([0.01, 0.0, 0.0]) + 0.05 * np.array([math.sin(angle), 0.2, math.cos(angle)])
    check(scene, look(eye, (0.01, 0, 0), (0.02, 0.02)), 300)


@pytest.mark.parametrize("gap", [pytest.param(0.0, marks=SLOW), 1e-4, pytest.param(5e-4, marks=SLOW), 2e-3])
def test_furnace_between_layers(gap):
    """Two different fabrics one on the other, at distances below, about and above their thickness."""
    scene = scenes.scene(
        [plane(10.0, 0), plane(10.0, 1, z=-gap)], [cloth_material(0), cloth_material(1)], [dome()], [WHITE, OTHER]
    )
    check(scene, look((0.02, -0.1, 0.1), (0, 0, 0)), 500)


def test_furnace_of_three_layers_on_a_white_body():
    """A body just under the cloth, inside of its thickness, is seen through the gaps and gives all light back."""
    white = lambert((1, 1, 1))
    cloth = fabric(fibers=4, radius=1.4e-4, albedo=(1, 1, 1))
    scene = scenes.scene(
        [plane(10.0, 0), plane(10.0, 1, z=-3e-4), plane(10.0, 2, z=-5e-4)],
        [cloth_material(0), cloth_material(1), white],
        [dome()],
        [cloth, OTHER],
    )
    check(scene, look((0.02, -0.1, 0.1), (0, 0, 0)), 400, error_limit=5e-3)


def test_furnace_at_a_grazing_angle():
    angle = math.radians(88.0)
    scene = scenes.scene([plane(10.0)], [cloth_material()], [dome()], [WHITE])
    eye = 0.3 * np.array([0.1, -math.sin(angle), math.cos(angle)])
    check(scene, look(eye, (0, 0, 0), (1e-2, 1e-2), up=(0, 0, 1)), 300)


def test_furnace_with_opposed_normals_and_interpenetration():
    """Two sheets that cut each other, one with its normals the wrong way round."""
    first = plane(0.1)
    second = scenes.sheet(
        lambda a, b: np.stack([0.1 * a - 0.05, 0.05 * b - 0.025, 0.1 * b - 0.05], axis=-1),
        lambda a, b: np.stack([0.1 * a, 0.11 * b], axis=-1), 2, 2,
    )  # fmt: skip
    second = replace(second, normals=-second.normals, face_material=second.face_material + 1)
    scene = scenes.scene([first, second], [cloth_material(0), cloth_material(1)], [dome()], [WHITE, OTHER])
    check(scene, look((0.02, -0.1, 0.1), (0, 0, 0), (0.3, 0.3)), 400)
