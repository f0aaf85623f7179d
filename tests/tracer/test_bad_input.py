"""Nonsense that reaches the tracer: no crash, no NaN, the rest of the scene as it should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane
from test_embree import shoot

from usdfab.errors import UsdfabError
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT, curve_scene
from usdfab.usd.scene import DistantLight, PointLight, Texture

CAMERA = look((0.05, 0.05, 0.3), (0.05, 0.05, 0), (0.2, 0.2))
SETTINGS = RenderSettings((16, 16), spp=16, max_depth=16)


@pytest.mark.parametrize("bad", ["no length", "no radius", "nan", "inf"])
def test_bad_curves_do_not_hide_the_good_one(bad):
    """A rod along x beside segments of no length, of no radius, at no place."""
    rod = np.array([[-1.0, 0, 0, 0.1], [0, 0, 0, 0.1], [1, 0, 0, 0.1], [2, 0, 0, 0.1]])
    other = rod + np.array([0.0, 0.0, 5.0, 0.0])
    if bad == "no length":
        other[:, 0] = 0.5
    elif bad == "no radius":
        other[:, 3] = 0.0
    else:
        other[1:3, :3] = np.nan if bad == "nan" else np.inf
    flags = np.full(6, NEIGHBOR_LEFT | NEIGHBOR_RIGHT, dtype=np.uint8)
    flags[[0, 3]], flags[[2, 5]] = NEIGHBOR_RIGHT, NEIGHBOR_LEFT
    scene = curve_scene(np.concatenate([rod, other]), np.array([0, 1, 2, 4, 5, 6], dtype=np.int32), flags)
    x = np.linspace(-0.5, 1.5, 50)
    origins = np.column_stack([x, np.zeros(50), np.full(50, 3.0)])
    down = np.broadcast_to([0.0, 0.0, -1.0], (50, 3))
    hit = shoot(scene, origins, down)
    np.testing.assert_allclose(hit.t, 2.9, atol=1e-4)
    up = shoot(scene, origins, -down)  # whatever comes back, it comes back
    assert up.t.shape == (50,)


def test_wild_meshes_give_finite_pictures():
    """Triangles without area, uv without Jacobian, on surfaces and on cloth, in every light."""
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0.05, 0.05, 0], [0, 0, 0]], dtype=float)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 2], [0, 0, 0], [0, 5, 1], [1, 1, 3]], dtype=np.int32)
    uv = points[triangles][..., :2].copy()
    uv[1] = 0.3  # no Jacobian
    sun = DistantLight("/Sun", np.array([0.0, 0, -1]), np.full(3, 2.0), 0.0)
    for normals in (None, np.broadcast_to([0.0, 0.0, 1.0], (6, 3, 3)), np.zeros((6, 3, 3))):
        for material in (0, 1):
            mesh = replace(
                plane(1.0), points=points, triangles=triangles, uv=uv, normals=normals,
                face_material=np.full(6, material, dtype=np.int32),
            )  # fmt: skip
            scene = scenes.scene([mesh], [lambert(), cloth_material()], [sun, dome()], [fabric()])
            seen = Tracer(scene).render(CAMERA, SETTINGS)
            for name in ("pixels", "normal", "albedo", "depth", "uv", "direct"):
                assert np.isfinite(getattr(seen, name)).all(), name
            if material == 0:
                np.testing.assert_allclose(seen.alpha[6:10, 6:10], 1.0)
                assert seen.pixels[6:10, 6:10].min() > 0.1


def test_a_mesh_of_nothing_but_points():
    """All triangles without area: an empty picture."""
    mesh = replace(plane(1.0), points=np.zeros((4, 3)))
    seen = Tracer(scenes.scene([mesh], [cloth_material()], [dome()], [fabric()])).render(CAMERA, SETTINGS)
    np.testing.assert_allclose(seen.pixels, 1.0)
    assert not seen.alpha.any()


def test_normals_that_face_away():
    """Normals authored the wrong way round, or along the surface: the cloth stays as bright as its triangles are."""
    pictures = []
    for normal in ((0.0, 0, 1), (0.0, 0, -1), (1.0, 0, 0)):
        mesh = replace(plane(0.2), normals=np.broadcast_to(normal, (2, 3, 3)))
        scene = scenes.scene([mesh], [cloth_material()], [dome()], [fabric(albedo=(1, 1, 1))])
        pictures.append(
            Tracer(scene).render(look((0.01, 0, 0.3), (0, 0, 0), (0.02, 0.02)), replace(SETTINGS, max_depth=2000))
        )
        assert np.isfinite(pictures[-1].pixels).all()
        assert pictures[-1].pixels.mean() == pytest.approx(1.0, abs=0.04)
        assert abs(pictures[-1].alpha.mean() - pictures[0].alpha.mean()) < 0.03


def test_only_what_glows_is_light_enough():
    glow = replace(lambert(), emissive=np.array([1.0, 1.0, 1.0]))
    Tracer(scenes.scene([plane(1.0)], [glow], []))
    matrix = np.array([[1.0, 0, 0], [0, 1, 0]])
    texture = Texture("none.png", "rgb", ("repeat", "repeat"), True, np.ones(4), np.zeros(4), matrix)
    textured = replace(lambert(), textures={"emissiveColor": texture})
    assert "none.png" in Tracer(scenes.scene([plane(1.0)], [textured], [])).warnings[0]
    with pytest.raises(UsdfabError, match="no light"):
        Tracer(scenes.scene([plane(1.0)], [lambert()], []))


def test_a_lamp_on_the_cloth_and_in_the_camera():
    """A point light within the cloth's thickness, at the eye, and on a surface: finite."""
    for place in ((0.05, 0.05, 0.0), (0.05, 0.05, 0.3), (0.05, 0.05, 1e-4)):
        lamp = PointLight("/P", np.array(place), np.ones(3))
        for material in (0, 1):
            mesh = plane(1.0, material)
            scene = scenes.scene([mesh], [lambert(), cloth_material()], [lamp], [fabric()])
            seen = Tracer(scene).render(CAMERA, SETTINGS)
            assert np.isfinite(seen.pixels).all() and np.isfinite(seen.variance).all()
