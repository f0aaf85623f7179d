"""Albedo maps and ``Mesh.albedo``: factors of the fiber albedo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image
from scenes import cloth_material, dome, fabric, look, plane

from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import DistantLight, Texture

SUN = DistantLight("/Sun", np.array([0.36, 0.48, -0.8]), np.full(3, 2.0), 0.0)
CAMERA = look((0.01, 0, 0.2), (0, 0, 0), (0.05, 0.05))
ALBEDO, TINT = np.array([0.8, 0.5, 0.3]), np.array([0.5, 0.9, 1.7])


def image(path, pixels) -> Texture:
    """A linear texture, clamped, uv in [0, 1]."""
    Image.fromarray(np.round(255 * np.asarray(pixels)).astype(np.uint8)).save(path)
    matrix = np.array([[1.0, 0, 0], [0, 1, 0]])
    return Texture(str(path), "rgb", ("clamp", "clamp"), True, np.ones(4), np.zeros(4), matrix)


def render(mesh, cloth, light=SUN, texture=None, meters_per_uv=1.0, camera=CAMERA, **settings):
    scene = scenes.scene([mesh], [cloth_material()], [light], [cloth])
    surface = replace(scene.fabrics[0], albedo_map=texture, meters_per_uv=meters_per_uv)
    values = {"resolution": (24, 24), "spp": 8, "max_depth": 12} | settings
    return Tracer(replace(scene, fabrics=(surface,)), strict=True).render(camera, RenderSettings(**values))


def tinted(mesh, tint):
    return replace(mesh, albedo=np.broadcast_to(tint, (len(mesh.triangles), 3, 3)))


@pytest.mark.parametrize("light", [SUN, dome()], ids=["sun", "dome"])
def test_a_tint_is_an_albedo(light):
    """C tinted by T looks as C T does: the same random numbers give the same picture but for rounding."""
    a = render(tinted(plane(0.1), TINT), fabric(albedo=tuple(ALBEDO)), light)
    b = render(plane(0.1), fabric(albedo=tuple(ALBEDO * TINT)), light)
    close = np.isclose(a.pixels, b.pixels, rtol=1e-3, atol=1e-5).all(axis=-1)
    assert close.mean() > 0.98  # a lobe that is drawn otherwise changes a path
    np.testing.assert_allclose(a.pixels.mean(axis=(0, 1)), b.pixels.mean(axis=(0, 1)), rtol=5e-3)
    np.testing.assert_allclose(a.albedo, b.albedo, rtol=1e-5)


def test_a_map_is_a_tint_and_both_multiply(tmp_path):
    texture = image(tmp_path / "t.png", np.broadcast_to([0.4, 0.8, 1.0], (4, 4, 3)))
    a = render(plane(0.1), fabric(albedo=tuple(ALBEDO)), texture=texture)
    b = render(tinted(plane(0.1), (0.4, 0.8, 1.0)), fabric(albedo=tuple(ALBEDO)))
    assert np.isclose(a.pixels, b.pixels, rtol=2e-3, atol=1e-5).all(axis=-1).mean() > 0.98
    c = render(tinted(plane(0.1), (0.5, 0.5, 0.5)), fabric(albedo=tuple(ALBEDO)), texture=texture)
    d = render(plane(0.1), fabric(albedo=tuple(ALBEDO * [0.2, 0.4, 0.5])))
    assert np.isclose(c.pixels, d.pixels, rtol=2e-3, atol=1e-5).all(axis=-1).mean() > 0.98


def test_an_albedo_is_never_above_one():
    a = render(tinted(plane(0.1), (5.0, 5.0, 5.0)), fabric(albedo=tuple(ALBEDO)), dome())
    b = render(plane(0.1), fabric(albedo=(1, 1, 1)), dome())
    np.testing.assert_allclose(a.albedo, b.albedo, atol=1e-5)
    assert np.isclose(a.pixels, b.pixels, rtol=1e-3, atol=1e-4).all(axis=-1).mean() > 0.98


def test_black_tints_are_finite():
    seen = render(tinted(plane(0.1), (0.0, 0.0, 1.0)), fabric(albedo=(0.5, 0.0, 1.0)), dome())
    assert np.isfinite(seen.pixels).all()
    # Red and green are left with what the cuticle reflects; blue stays white.
    assert seen.pixels[..., 0].mean() < 0.5 * seen.pixels[..., 2].mean()


def test_one_is_no_tint():
    a = render(tinted(plane(0.1), (1.0, 1.0, 1.0)), fabric())
    b = render(plane(0.1), fabric())
    assert np.isclose(a.pixels, b.pixels, rtol=1e-6, atol=1e-7).all(axis=-1).mean() > 0.98


@pytest.mark.parametrize("meters_per_uv", [1.0, 0.02])
def test_maps_lie_where_uv_says(tmp_path, meters_per_uv):
    """Four colours: the origin of uv is the lower left of the picture, whatever the cloth's scale."""
    quarters = np.array([[[1.0, 0.2, 0.2], [0.2, 1.0, 0.2]], [[0.2, 0.2, 1.0], [1.0, 1.0, 1.0]]])
    texture = image(tmp_path / "q.png", np.kron(quarters, np.ones((16, 16, 1))))
    mesh = plane(0.02)
    mesh = replace(mesh, uv=mesh.uv / 0.02 + 0.5)
    seen = render(
        mesh, fabric(albedo=(0.9, 0.9, 0.9)), dome(), texture, meters_per_uv,
        look((0, 0, 0.2), (0, 0, 0), (0.05, 0.05)), spp=16,
    )  # fmt: skip
    for i in range(2):
        for j in range(2):
            part = (slice(12 * i + 2, 12 * i + 10), slice(12 * j + 2, 12 * j + 10))
            ratio = seen.albedo[part].sum(axis=(0, 1)) / seen.alpha[part].sum()
            np.testing.assert_allclose(ratio, 0.9 * quarters[i, j], atol=0.02)
            if (i, j) != (1, 1):
                assert seen.pixels[part].mean(axis=(0, 1)).argmax() == quarters[i, j].argmax()


def test_colours_of_points_are_interpolated():
    """A ramp along x from the corners' colours, alike on both triangles."""
    mesh = plane(0.02)
    ramp = mesh.points[mesh.triangles][..., 0] / 0.02 + 0.5
    mesh = replace(mesh, albedo=np.stack([ramp, 1.0 - ramp, np.full_like(ramp, 0.5)], axis=-1))
    seen = render(
        mesh, fabric(albedo=(1, 1, 1)), dome(), camera=look((0, 0, 0.2), (0, 0, 0), (0.05, 0.05)), spp=64, max_depth=1
    )
    mean = seen.albedo.sum(axis=0) / seen.alpha.sum(axis=0)[:, None]
    x = (np.arange(24) + 0.5) / 24
    np.testing.assert_allclose(mean[1:-1], np.stack([x, 1 - x, 0 * x + 0.5], axis=-1)[1:-1], atol=0.02)


def test_a_tint_stays_with_its_mesh():
    """A tinted open fabric over a plain one: what is seen through its gaps has its own colour."""
    open_cloth, below = fabric(fibers=3, radius=1.2e-4, albedo=(1, 1, 1)), fabric(albedo=(0.6, 0.6, 0.6))
    meshes = [tinted(plane(0.1), (1.0, 0.1, 0.1)), plane(0.1, 1, z=-0.02)]
    scene = scenes.scene(meshes, [cloth_material(0), cloth_material(1)], [SUN], [open_cloth, below])
    seen = Tracer(scene).render(
        look((0, 0, 0.2), (0, 0, 0), (1e-2, 1e-2)), RenderSettings((64, 64), spp=1, max_depth=1)
    )
    colours = seen.albedo.reshape(-1, 3)
    red = np.isclose(colours, [1.0, 0.1, 0.1], atol=1e-4).all(axis=1)
    grey = np.isclose(colours, [0.6, 0.6, 0.6], atol=1e-4).all(axis=1)
    assert red.mean() > 0.1 and grey.mean() > 0.1
    assert np.all(red | grey | ~colours.any(axis=1))
