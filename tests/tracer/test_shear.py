"""Cloth whose texture coordinates rotate, stretch, shear and mirror it, against fibers in a plain coordinate system."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, look, plane

from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import tile_copies
from usdfab.tracer.reference import reference_fibers, trace
from usdfab.usd.scene import DistantLight

# uv = map @ (x, y): rows are the gradients of the cloth's x and y.
MAPS = {
    "plain": [[1.0, 0.0], [0.0, 1.0]],
    "rotated": [[0.8, 0.6], [-0.6, 0.8]],
    "stretched": [[1.6, 0.0], [0.0, 0.7]],
    "sheared": [[1.0, 0.6], [0.0, 1.0]],
    "mirrored": [[-1.0, 0.0], [0.0, 1.0]],
    "all": [[-1.3, 0.5], [0.3, 0.8]],
}


def mapped_plane(linear, side=0.1, material=0):
    """A square in the world's xy plane whose uv are those of a linear map."""
    mesh = plane(side, material)
    return replace(mesh, uv=mesh.uv @ np.asarray(linear, dtype=float).T)


def to_cloth(linear):
    """World to the space of the fibers: heights are scaled by the root of the area's change."""
    linear = np.asarray(linear, dtype=float)
    whole = np.eye(3)
    whole[:2, :2] = linear
    whole[2, 2] = math.sqrt(abs(np.linalg.det(linear)))
    return whole


def needle(origin, direction):
    """A camera that sees one ray."""
    return look(origin, np.asarray(origin) + direction, (1e-9, 1e-9), up=(0.3, 1.0, 0.2))


def rays(count, seed, below):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        target = np.r_[rng.uniform(-5e-3, 5e-3, 2), 0.0]
        direction = np.r_[rng.uniform(-0.8, 0.8, 2), 1.0 if below else -1.0]
        direction /= np.linalg.norm(direction)
        yield target - 0.02 * direction, direction


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("name", MAPS)
def test_rays_meet_the_fibers_of_the_mapped_cloth(name, below):
    """Where single rays hit: distance, normal and whether at all, against a search over all fibers."""
    cloth = fabric(fibers=4, radius=1.6e-4)
    fibers = reference_fibers(cloth, generate_patch(cloth, copies=tile_copies(cloth)))
    whole = to_cloth(MAPS[name])
    tracer = Tracer(scenes.scene([mapped_plane(MAPS[name])], [cloth_material()], [dome()], [cloth]))
    settings = RenderSettings((1, 1), spp=1, max_depth=1, threads=1)
    same = seen = 0
    errors, normals = [], []
    count = 120
    for origin, direction in rays(count, 3, below):
        own = whole @ direction
        stretch = np.linalg.norm(own)
        distance, segment, _, shift = trace(fibers, whole @ origin, own / stretch)
        render = tracer.render(needle(origin, direction), settings)
        hit = render.alpha[0, 0] > 0.5
        same += hit == (segment >= 0)
        if not hit or segment < 0:
            continue
        seen += 1
        error = abs(render.depth[0, 0] - distance / stretch) * stretch / fibers.radius[segment]
        errors.append(error)
        if error < 0.1:
            # The cylinder's normal is a covector, as seen in the world.
            place = whole @ origin + own * (distance / stretch) - fibers.a[segment] - shift
            across = place - (place @ fibers.axis[segment]) * fibers.axis[segment]
            normal = whole.T @ across
            normals.append(render.normal[0, 0] @ normal / np.linalg.norm(normal))
    assert 0.1 < seen / count < 0.98
    assert same >= 0.97 * count  # silhouettes: chords of several knots there, of one knot here
    assert np.median(errors) < 0.03 and np.mean(np.array(errors) < 0.2) > 0.95
    assert np.median(normals) > 0.999 and np.mean(np.array(normals) > 0.98) > 0.9


@pytest.mark.parametrize("name", [n for n in MAPS if n != "plain"])
def test_coverage_of_parallel_light(name):
    """Share of slanting light that comes through open cloth onto a white ground: depth 2, shadow rays."""
    cloth = fabric(fibers=3, radius=1.2e-4)
    fibers = reference_fibers(cloth, generate_patch(cloth, copies=tile_copies(cloth)))
    whole = to_cloth(MAPS[name])
    direction = np.array([0.5, 0.3, -1.0]) / np.linalg.norm([0.5, 0.3, -1.0])
    own = whole @ direction
    own /= np.linalg.norm(own)
    # One tile of the cloth, whatever its shape in the world.
    n = 70
    x, y = ((np.arange(n) + 0.5) / n * side for side in fibers.size)
    free = np.mean([trace(fibers, np.array([a, b, 1e-2]), own)[1] < 0 for a in x for b in y])
    sun = DistantLight("/Sun", direction, np.full(3, math.pi / -direction[2]), 0.0)
    scene = scenes.scene(
        [mapped_plane(MAPS[name], 0.2), plane(0.2, 1, z=-0.05)],
        [cloth_material(), scenes.lambert((1, 1, 1))],
        [sun],
        [cloth],
    )
    camera = look((0, 0, -0.01), (0, 0, -0.05), (0.3, 0.3))
    render = Tracer(scene).render(camera, RenderSettings((64, 64), spp=16, max_depth=2))
    assert 0.05 < free < 0.8
    assert abs(render.pixels.mean() - free) < 1.0 / n + 0.01


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("name", ["stretched", "sheared", "all"])
def test_furnace(name, below):
    """White cloth in white light is white from both faces, however its uv distort it."""
    scene = scenes.scene([mapped_plane(MAPS[name], 10.0)], [cloth_material()], [dome()], [fabric(albedo=(1, 1, 1))])
    eye = (0.02, -0.05, -0.1 if below else 0.1)
    render = Tracer(scene).render(look(eye, (0, 0, 0)), RenderSettings((24, 24), spp=160, max_depth=2000))
    mean = render.pixels.mean(axis=(0, 1), dtype=float)
    error = np.sqrt(render.variance.sum(axis=(0, 1))) / render.alpha.size
    assert error.max() < 4e-3 and np.all(abs(mean - 1.0) < 4 * error), f"{mean} +- {error}"


def test_rotated_uv_is_a_rotated_world():
    """Cloth turned by its uv under a lamp, against the lamp and camera turned the other way: many bounces."""
    turn = np.eye(3)
    turn[:2, :2] = MAPS["rotated"]
    cloth = fabric(albedo=(0.8, 0.5, 0.3))
    light = np.array([0.6, 0.0, -0.8])
    settings = RenderSettings((32, 32), spp=64, max_depth=8)
    pictures = []
    for linear, world, seed in ((MAPS["rotated"], np.eye(3), 0), (MAPS["plain"], turn, 1)):
        scene = scenes.scene(
            [mapped_plane(linear)],
            [cloth_material()],
            [DistantLight("/Sun", world @ light, np.full(3, 3.0), 0.0)],
            [cloth],
        )
        camera = look(world @ (0.01, 0.0, 0.1), (0, 0, 0), (0.012, 0.012), up=world @ (0.0, 1.0, 0.0))
        pictures.append(Tracer(scene).render(camera, replace(settings, seed=seed)))

    def blocks(image):
        return image.reshape(8, 4, 8, 4, -1).mean(axis=(1, 3), dtype=float)

    a, b = pictures
    z = (blocks(a.pixels) - blocks(b.pixels)) / np.sqrt((blocks(a.variance) + blocks(b.variance)) / 16)
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.std(blocks(a.pixels)[..., 0]) > 0.01  # there is something to compare


@pytest.mark.parametrize("seam", ["zero uv area", "no area", "opposed"])
def test_bad_neighbours_leave_the_cloth_alone(seam):
    """Faces without area or without Jacobian, or turned over in uv, beside good ones of a smooth mesh."""
    mesh = scenes.sheet(
        lambda a, b: np.stack([0.1 * a - 0.05, 0.1 * b - 0.05, 0 * a], axis=-1),
        lambda a, b: np.stack([0.1 * a - 0.05, 0.1 * b - 0.05], axis=-1), 8, 8,
    )  # fmt: skip
    camera = look((0, 0, 0.2), (0, 0, 0), (0.05, 0.05))
    settings = RenderSettings((48, 48), spp=1, max_depth=4)

    def render(m):
        return Tracer(scenes.scene([m], [cloth_material()], [dome()], [fabric()])).render(camera, settings)

    good = render(mesh)
    middle = 4 * 8 + 4
    uv, triangles, normals = mesh.uv.copy(), mesh.triangles, mesh.normals
    faces = mesh.face_material
    if seam == "zero uv area":
        uv[middle] = uv[middle, 0]
    elif seam == "opposed":
        uv[middle] = uv[middle][:, ::-1]
    else:
        corner = triangles[middle]
        extra = np.array([[corner[0], corner[1], corner[1]], [corner[2], corner[2], corner[2]]] * 5, dtype=np.int32)
        triangles = np.concatenate([triangles, extra])
        uv = np.concatenate([uv, np.random.default_rng(0).uniform(-1, 1, (10, 3, 2))])
        normals = np.concatenate([normals, np.broadcast_to([0.0, 0, 1], (10, 3, 3))])
        faces = np.zeros(len(triangles), dtype=np.int32)
    bad = render(replace(mesh, uv=uv, triangles=triangles, normals=normals, face_material=faces))
    assert np.isfinite(bad.pixels).all() and np.isfinite(bad.normal).all()
    if seam == "no area":
        np.testing.assert_array_equal(bad.pixels, good.pixels)
    else:  # the bad triangle lies at x, y > 0
        x, y = np.meshgrid(*2 * [(np.arange(48) + 0.5) / 24 - 1.0])
        away = (x < -0.05) | (y > 0.05)
        # One turned over has a share in the mean at its corners: its neighbours' cloth bends a little.
        assert np.mean(bad.fiber_id[away] != good.fiber_id[away]) <= (0.02 if seam == "opposed" else 0.0)
