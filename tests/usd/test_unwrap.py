"""Cloth without texture coordinates: lengths in uv are lengths on the cloth."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.read_scene import read_scene
from usdfab.usd.stretch import surfaces
from usdfab.usd.unwrap import _unfolded, unwrap, unwrap_faces


def sheet(n, height):
    """A square of 1 m with folds of a height, as quads."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    return np.stack([x, y, height * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3), quads


def stretch(points, triangles, uv):
    """(T, 2) singular values of the map from the surface to uv."""
    p, e = points[triangles], uv[:, 1:] - uv[:, :1]
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    x = a / np.linalg.norm(a, axis=1, keepdims=True)
    y = np.cross(np.cross(a, b), x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    local = np.stack([np.stack([(v * x).sum(1), (v * y).sum(1)], axis=1) for v in (a, b)], axis=2)
    return np.linalg.svd(e.transpose(0, 2, 1) @ np.linalg.inv(local), compute_uv=False)


def triangles_of(quads):
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def test_flat_cloth_is_unwrapped_without_distortion():
    points, quads = sheet(8, 0.0)
    turned = points @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] + [100, 50, 20]
    uv = unwrap(turned, triangles_of(quads))
    np.testing.assert_allclose(stretch(turned, triangles_of(quads), uv), 1.0, rtol=1e-4)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 100.0])
def test_folds_keep_lengths(scale):
    points, quads = sheet(24, 0.08)
    points, triangles = scale * points, triangles_of(quads)
    uv = unwrap(points, triangles)
    found = stretch(points, triangles, uv)
    assert found.min() > 0.75 and found.max() < 1.25
    assert np.abs(found - 1).mean() < 0.05
    edges = uv[:, 1:] - uv[:, :1]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    p = points[triangles]
    assert area == pytest.approx(0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum())
    np.testing.assert_array_equal(uv, unwrap(points, triangles))


def test_faces_stay_whole():
    points, quads = sheet(12, 0.3)
    uv = unwrap_faces(points, np.full(len(quads), 4), quads.ravel()).reshape(-1, 4, 2)
    sides = np.linalg.norm(points[quads] - np.roll(points[quads], 1, axis=1), axis=2)
    np.testing.assert_allclose(np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2), sides, rtol=0.3)


def test_slivers_and_dust():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 0)], dtype=float)
    uv = unwrap(points, np.array([[0, 1, 2], [0, 4, 1], [2, 2, 2], [0, 2, 3]]))
    assert np.isfinite(uv).all() and (uv[1] == 0).all()
    with pytest.raises(UsdfabError, match="no area to unwrap"):
        unwrap(points, np.array([[0, 4, 1]]))


# --- in stages -------------------------------------------------------------------------------------------------------


def yarn_scale(scene):
    """Metres of cloth per metre of world along the two edges of each triangle of the first mesh."""
    mesh, surface = scene.meshes[0], scene.fabrics[0]
    return stretch(mesh.points, mesh.triangles, mesh.uv * surface.meters_per_uv)


@pytest.mark.parametrize("meters", [1.0, 0.01])
@pytest.mark.parametrize("how", ["missing", "degenerate"])
def test_cloth_without_coordinates(cloth_stage, meters, how):
    UsdGeom.SetStageMetersPerUnit(cloth_stage, meters)
    mesh = cloth_stage.GetPrimAtPath("/World/Cloth")
    UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(2, 4, 1))
    cloth_stage.GetPrimAtPath("/World/Looks/Fabric").GetAttribute("usdfab:metersPerUv").Set(0.125)
    if how == "missing":
        UsdGeom.PrimvarsAPI(mesh).RemovePrimvar("st")
    else:
        UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Set([Gf.Vec2f(0.5, 0.5)] * 4)
    scene = read_scene(cloth_stage)
    np.testing.assert_allclose(yarn_scale(scene), 1.0, rtol=1e-4)
    # metres per uv that the fabric asks for are those of coordinates that people made
    assert scene.fabrics[0].meters_per_uv == pytest.approx(1.0)
    expected = {"missing": "has no texture coordinates", "degenerate": "has texture coordinates that cover no area"}
    assert scene.warnings[0].startswith(f"/World/Cloth: the cloth {expected[how]}; it is unwrapped")


def test_only_cloth_is_unwrapped(cloth_stage, new_mesh):
    new_mesh(cloth_stage, "/World/Floor", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]])
    scene = read_scene(cloth_stage)
    assert scene.warnings == () and scene.meshes[1].uv is None


def test_unwrapped_subdivision_cage(fabric):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    points, quads = sheet(8, 0.05)
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    mesh.CreateFaceVertexCountsAttr([4] * len(quads))
    mesh.CreateFaceVertexIndicesAttr(quads.ravel().tolist())
    scene = read_scene(stage, fabric_override=fabric)
    assert len(scene.meshes[0].triangles) == len(quads) * 32
    found = yarn_scale(scene)
    assert np.abs(found - 1).mean() < 0.06 and found.min() > 0.7 and found.max() < 1.4


def test_moving_cloth_keeps_its_charts(cloth_stage):
    mesh = cloth_stage.GetPrimAtPath("/World/Cloth")
    UsdGeom.PrimvarsAPI(mesh).RemovePrimvar("st")
    points = UsdGeom.Mesh(mesh).GetPointsAttr()
    for time, height in ((1.0, 0.0), (5.0, 0.7)):
        points.Set([Gf.Vec3f(0, 0, 0), Gf.Vec3f(1, 0, 0), Gf.Vec3f(1, 1, height), Gf.Vec3f(0, 1, 0)], time)
    turn = UsdGeom.Xformable(mesh).AddRotateZOp()
    turn.Set(0.0, 1.0)
    turn.Set(77.0, 5.0)
    one, two = (read_scene(cloth_stage, time=t) for t in (1.0, 4.0))
    assert np.abs(one.meshes[0].points - two.meshes[0].points).max() > 0.1
    np.testing.assert_allclose(one.meshes[0].uv, two.meshes[0].uv, atol=1e-6)
    assert one.fabrics[0].meters_per_uv == pytest.approx(two.fabrics[0].meters_per_uv)


def test_a_bent_face_is_unfolded():
    # two triangles at a right angle about the diagonal: flat, they are a square again
    half = np.sqrt(0.5)
    triangle = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]], dtype=float)
    point = np.array([(0.5, 0.5, half)])
    np.testing.assert_allclose(_unfolded(triangle, point), [[-1, 1, 1]], atol=1e-12)
    # its own corners stay
    for k in range(3):
        np.testing.assert_allclose(_unfolded(triangle, triangle[:, k]), np.eye(3)[[k]], atol=1e-12)


@pytest.mark.parametrize("handed", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("side", [1, -1])
def test_nothing_is_mirrored_seen_from_the_front(fabric, handed, side):
    # A closed box and a folded sheet make many charts.
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    points, quads = sheet(10, 0.3)
    box = np.array([(x, y, z) for z in (2, 3) for y in (0, 1) for x in (0, 1)], dtype=float)
    faces = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in np.concatenate([points, box])])
    mesh.CreateFaceVertexCountsAttr([4] * (len(quads) + 6))
    mesh.CreateFaceVertexIndicesAttr(np.concatenate([quads, faces + len(points)]).ravel().tolist())
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateOrientationAttr(handed)
    mesh.AddScaleOp().Set(Gf.Vec3f(side, 1, 1))
    scene = read_scene(stage, fabric_override=fabric)
    (surface,) = surfaces(scene, 1.25)
    assert surface.report.mirrored < 1e-6 and surface.report.degenerate == 0
