"""Placed copies of meshes against the same meshes written out in the world."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane

from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import DistantLight, Mesh, PointLight


def turned(axis, degrees, scale=1.0, offset=(0.0, 0.0, 0.0)):
    """A placement (3, 4): rotation about an axis, scale, then translation."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return np.column_stack([rotation * np.asarray(scale), offset])


def written_out(mesh: Mesh) -> list[Mesh]:
    """A mesh for each copy, in the world. Mirroring copies get their corners in the other order."""
    if mesh.placements is None:
        return [mesh]
    meshes = []
    for k, matrix in enumerate(mesh.placements):
        linear = matrix[:, :3]
        order = [0, 1, 2] if np.linalg.det(linear) > 0 else [0, 2, 1]
        normals = None
        if mesh.normals is not None:
            normals = (mesh.normals @ np.linalg.inv(linear))[:, order]
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        meshes.append(
            replace(
                mesh,
                path=f"{mesh.path}/{k}",
                points=mesh.points @ linear.T + matrix[:, 3],
                triangles=mesh.triangles[:, order],
                normals=normals,
                uv=None if mesh.uv is None else mesh.uv[:, order],
                albedo=None if mesh.albedo is None else mesh.albedo[:, order],
                placements=None,
            )
        )
    return meshes


SUN = DistantLight("/Sun", np.array([0.36, 0.48, -0.8]), np.full(3, 2.0), 0.0)


def both(meshes, materials, lights, camera, settings, fabrics=()):
    """The picture of copies, and that of the same meshes written out."""
    scene = scenes.scene(meshes, materials, lights, fabrics)
    apart = replace(scene, meshes=tuple(part for mesh in meshes for part in written_out(mesh)))
    return Tracer(scene).render(camera, settings), Tracer(apart).render(camera, settings)


def differing(a, b, tolerance=2e-3):
    """Share of pixels whose values differ by more than rounding."""
    a, b = (np.reshape(x, (*x.shape[:2], -1)) for x in (a, b))
    return float(np.mean(np.abs(a - b).max(axis=-1) > tolerance * (1.0 + np.abs(a).max(axis=-1))))


def blocks(image, size=8):
    height, width = image.shape[:2]
    return image.reshape(height // size, size, width // size, size, -1).mean(axis=(1, 3), dtype=float)


def agree(a, b, size=8):
    """Root mean square of the differences of blocks, in standard errors, of two pictures of different seeds."""
    z = (blocks(a.pixels) - blocks(b.pixels)) / np.sqrt((blocks(a.variance) + blocks(b.variance)) / size**2 + 1e-12)
    return float(np.sqrt(np.mean(z**2)))


COPIES = {
    "moved": [turned((0, 0, 1), 0, 1.0, (-0.02, 0, 0)), turned((0, 0, 1), 0, 1.0, (0.02, 0, 0))],
    "rotated": [turned((0, 0, 1), 35), turned((1, 0, 0), 50, 1.0, (0.02, 0.02, 0)), turned((1, 2, 3), 160)],
    "scaled": [turned((0, 0, 1), 20, 2.5, (-0.02, 0, 0)), turned((0, 1, 0), 30, 0.5, (0.03, 0, 0))],
    "stretched": [turned((0, 0, 1), 20, (2.0, 0.7, 1.4)), turned((1, 1, 0), 40, (0.5, 1.0, 3.0), (0.03, 0, 0.01))],
    "mirrored": [turned((0, 0, 1), 20, (-1.0, 1.0, 1.0)), turned((0, 1, 0), 30, (1.0, 1.0, -1.0), (0.03, 0, 0.01))],
}
VIEW = look((0.01, -0.04, 0.25), (0.005, 0, 0), (0.16, 0.16))


# Curved and stretched is left out: normals are made unit vectors before or after they are interpolated.
@pytest.mark.parametrize(
    ("kind", "shape"), [(k, "flat") for k in COPIES] + [(k, "curved") for k in COPIES if k != "stretched"]
)
def test_fabrics_on_copies(kind, shape):
    """First hits and direct light, pixel by pixel; flat or with interpolated normals."""
    mesh = plane(0.025) if shape == "flat" else scenes.strip(0.012)
    mesh = replace(mesh, placements=np.stack(COPIES[kind]))
    settings = RenderSettings((40, 40), spp=4, max_depth=2)
    one, two = both([mesh], [cloth_material()], [SUN], VIEW, settings, [fabric()])
    assert one.alpha.mean() > 0.15
    for name in ("pixels", "normal", "depth", "uv", "alpha", "albedo"):
        assert differing(getattr(one, name), getattr(two, name)) < 0.03, name
    assert np.mean(one.fiber_id != two.fiber_id) < 0.01
    np.testing.assert_allclose(one.pixels.mean(), two.pixels.mean(), rtol=1e-2)


@pytest.mark.parametrize("kind", ["rotated", "scaled", "mirrored"])
def test_light_among_copies_of_fabric(kind):
    """Many bounces, different seeds: the copies see each other as meshes do."""
    mesh = replace(plane(0.03), placements=np.stack(COPIES[kind]))
    lamp = PointLight("/Lamp", np.array([0.01, -0.05, 0.1]), np.full(3, 0.01))
    scene = scenes.scene([mesh], [cloth_material()], [lamp], [fabric(albedo=(0.95, 0.9, 0.7))])
    apart = replace(scene, meshes=tuple(written_out(mesh)))
    a, b = (
        Tracer(s).render(VIEW, RenderSettings((32, 32), spp=64, max_depth=12, seed=n))
        for n, s in enumerate((scene, apart))
    )
    assert agree(a, b) < 1.5


def test_surfaces_and_fabrics_of_many_meshes():
    """Several prototypes, several copies of each, meshes without copies between them: every number finds its own."""
    colors = [(0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.2, 0.3, 0.9)]
    materials = [lambert(c) for c in colors] + [cloth_material(0), cloth_material(1)]
    first, second = fabric(albedo=(0.8, 0.8, 0.1)), fabric("twill 2/2", albedo=(0.1, 0.7, 0.7))
    rng = np.random.default_rng(5)

    def some(count):
        return np.stack(
            [
                turned(rng.normal(size=3), rng.uniform(0, 360), rng.uniform(0.6, 1.8), rng.uniform(-0.03, 0.03, 3))
                for _ in range(count)
            ]
        )

    two = plane(0.016, 0)
    two = replace(two, face_material=np.array([0, 3], dtype=np.int32))
    meshes = [
        plane(0.01, 1, z=0.02),
        replace(two, placements=some(3)),
        plane(0.012, 4, center=(0.01, -0.01)),
        replace(plane(0.012, 2), placements=some(2)),
        replace(plane(0.016, 4), placements=some(4)),
    ]
    one, other = both(
        meshes, materials, [SUN, dome(0.3)], VIEW, RenderSettings((48, 48), spp=4, max_depth=2), [first, second]
    )
    assert len({tuple(np.round(c, 1)) for c in one.albedo.reshape(-1, 3)}) >= 6
    for name in ("albedo", "depth", "uv", "normal", "alpha"):
        assert differing(getattr(one, name), getattr(other, name)) < 0.03, name
    np.testing.assert_allclose(one.pixels.mean(axis=(0, 1)), other.pixels.mean(axis=(0, 1)), rtol=0.02)


def test_each_copy_skips_itself_only():
    """White cloth in white light, copies so close that their slabs overlap: no light is lost at the change of slabs."""
    close = np.stack([turned((0, 0, 1), a, 1.0, (0, 0, z)) for a, z in ((0, 0.0), (30, 4e-4), (70, 1.5e-3))])
    mesh = replace(plane(10.0), placements=close)
    scene = scenes.scene([mesh], [cloth_material()], [dome()], [fabric(albedo=(1, 1, 1), radius=1.6e-4)])
    render = Tracer(scene).render(look((0, -0.1, 0.1), (0, 0, 0)), RenderSettings((24, 24), spp=256, max_depth=2000))
    mean = render.pixels.mean(axis=(0, 1), dtype=float)
    error = np.sqrt(render.variance.sum(axis=(0, 1))) / render.alpha.size
    assert error.max() < 4e-3 and np.all(abs(mean - 1.0) < 4 * error), f"{mean} +- {error}"


def test_copies_shadow_each_other():
    """Open cloth lets light through to a copy beneath, as it does to a mesh of its own."""
    cloth = fabric(fibers=3, radius=1.2e-4)
    floor = plane(0.5, 1, z=-0.02)
    mesh = replace(plane(0.2), placements=np.stack([turned((0, 0, 1), 15), turned((0, 0, 1), 75, 1.0, (0, 0, 0.01))]))
    camera = look((0, 0, -0.005), (0, 0, -0.02), (0.3, 0.3))
    one, two = both(
        [mesh, floor],
        [cloth_material(), lambert((1, 1, 1))],
        [SUN],
        camera,
        RenderSettings((40, 40), spp=16, max_depth=2),
        [cloth],
    )
    assert 0.02 < one.pixels.mean() < 0.5
    assert differing(one.pixels, two.pixels) < 0.05
    np.testing.assert_allclose(one.pixels.mean(), two.pixels.mean(), rtol=5e-3)


def test_yarns_grow_with_a_copy_and_do_not_tear():
    """Across the triangles of one copy the cloth is the same that one large triangle has: place and map agree."""
    whole = replace(plane(0.02), placements=turned((0, 0, 1), 0, 3.0)[None])
    cut = scenes.sheet(
        lambda a, b: np.stack([0.02 * a - 0.01, 0.02 * b - 0.01, 0 * a], axis=-1),
        lambda a, b: np.stack([0.02 * a - 0.01, 0.02 * b - 0.01], axis=-1), 16, 16,
    )  # fmt: skip
    cut = replace(cut, normals=None, placements=whole.placements)
    camera = look((0, 0, 0.2), (0.0, 0, 0), (0.02, 0.02))
    settings = RenderSettings((64, 64), spp=1, max_depth=1)
    ids = [
        Tracer(scenes.scene([m], [cloth_material()], [dome()], [fabric()])).render(camera, settings)
        for m in (whole, cut)
    ]
    assert np.mean(ids[0].fiber_id != ids[1].fiber_id) < 0.02
    # The same as plain cloth seen from a third of the distance.
    near = Tracer(scenes.scene([plane(0.02)], [cloth_material()], [dome()], [fabric()])).render(
        look((0, 0, 0.2 / 3), (0.0, 0, 0), (0.02, 0.02)), settings
    )
    assert np.mean(ids[0].fiber_id != near.fiber_id) < 0.02
    np.testing.assert_allclose(near.uv, ids[0].uv, atol=1e-6)


def test_a_copy_without_size_is_not_there():
    mesh = replace(plane(0.02), placements=np.stack([turned((0, 0, 1), 10), turned((0, 0, 1), 0, (1.0, 0.0, 1.0))]))
    alone = replace(mesh, placements=mesh.placements[:1])
    settings = RenderSettings((24, 24), spp=4, max_depth=4)
    a, b = (
        Tracer(scenes.scene([m], [cloth_material()], [dome()], [fabric()])).render(VIEW, settings)
        for m in (mesh, alone)
    )
    assert np.isfinite(a.pixels).all()
    np.testing.assert_array_equal(a.pixels, b.pixels)
