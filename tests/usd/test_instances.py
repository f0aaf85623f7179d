"""Copies: native instances and point instancers, against transforms worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from usdfab.errors import UsdfabError
from usdfab.usd.read_scene import read_scene

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
UV = [(x, y) for x, y, _ in SQUARE]


def stage_in(meters=1.0):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    return stage


def placed_points(mesh):
    """(K, V, 3) world points of every copy."""
    if mesh.placements is None:
        return mesh.points[None]
    return np.einsum("kij,vj->kvi", mesh.placements[:, :, :3], mesh.points) + mesh.placements[:, None, :, 3]


def all_copies(scene):
    return np.concatenate([placed_points(m) for m in scene.meshes])


def instances(stage, new_mesh, number):
    stage.CreateClassPrim("/_Proto")
    new_mesh(stage, "/_Proto/M", SQUARE, [[0, 1, 2, 3]], UV)
    for k in range(number):
        prim = stage.DefinePrim(f"/I{k}", "Xform")
        prim.GetReferences().AddInternalReference("/_Proto")
        prim.SetInstanceable(True)
        xform = UsdGeom.Xformable(prim)
        xform.AddTranslateOp().Set(Gf.Vec3d(10 * k, 0, 0))
        xform.AddScaleOp().Set(Gf.Vec3f(k + 1))
    return [np.array(SQUARE) * (k + 1) + [10 * k, 0, 0] for k in range(number)]


@pytest.mark.parametrize("meters", [1.0, 0.01])
def test_native_instances_are_shared(new_mesh, meters):
    stage = stage_in(meters)
    expected = instances(stage, new_mesh, 5)
    (mesh,) = read_scene(stage).meshes
    assert mesh.path == "/I0/M" and mesh.placements.shape == (5, 3, 4) and mesh.placements_close is None
    np.testing.assert_allclose(placed_points(mesh), np.array(expected) * meters, atol=1e-12)
    np.testing.assert_array_equal(mesh.placements[0], np.eye(3, 4))
    apart = read_scene(stage, placements=False).meshes
    assert [m.path for m in apart] == [f"/I{k}/M" for k in range(5)]
    np.testing.assert_allclose([m.points for m in apart], np.array(expected) * meters, atol=1e-12)


def test_mirrored_instances_keep_their_front(new_mesh):
    stage = stage_in()
    instances(stage, new_mesh, 8)
    for k in range(4):
        UsdGeom.Xformable(stage.GetPrimAtPath(f"/I{k}")).AddScaleOp(opSuffix="mirror").Set(Gf.Vec3f(-1, 1, 1))
    meshes = read_scene(stage).meshes
    assert len(meshes) == 2
    for mesh in meshes:
        assert (np.linalg.det(mesh.placements[:, :, :3]) > 0).all()
        a, b, c = (placed_points(mesh)[:, mesh.triangles[:, k]] for k in range(3))
        assert (np.cross(b - a, c - a)[..., 2] > 0).all()


def test_instances_with_other_colors_or_materials_are_apart(new_mesh):
    stage = stage_in()
    instances(stage, new_mesh, 8)
    for k in range(4):
        root = stage.GetPrimAtPath(f"/I{k}")
        UsdGeom.PrimvarsAPI(root).CreatePrimvar("usdfab:albedo", Sdf.ValueTypeNames.Color3f, "constant").Set(
            Gf.Vec3f(1, 0, 0)
        )
    red, plain = read_scene(stage).meshes
    np.testing.assert_allclose(red.albedo, np.broadcast_to([1, 0, 0], (2, 3, 3)))
    assert plain.albedo is None and len(red.placements) == len(plain.placements) == 4
    material = UsdShade.Material.Define(stage, "/Look")
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/I7")).Bind(material)
    scene = read_scene(stage)
    assert [len(placed_points(m)) for m in scene.meshes] == [4, 1, 1, 1, 1]
    assert scene.materials[scene.meshes[-1].face_material[0]].path == "/Look"


def point_instancer(stage, new_mesh, path="/P"):
    """Two prototypes, the second moved and of two meshes; six copies."""
    instancer = UsdGeom.PointInstancer.Define(stage, path)
    over = stage.OverridePrim(f"{path}/Protos")
    new_mesh(stage, f"{over.GetPath()}/A", SQUARE, [[0, 1, 2, 3]], UV)
    group = UsdGeom.Xform.Define(stage, f"{over.GetPath()}/B")
    group.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    for k in range(2):
        part = new_mesh(stage, f"{group.GetPath()}/M{k}", SQUARE, [[0, 1, 2, 3]])
        UsdGeom.Xformable(part).AddTranslateOp().Set(Gf.Vec3d(0, k, 0))
    instancer.CreatePrototypesRel().SetTargets([f"{over.GetPath()}/A", f"{over.GetPath()}/B"])
    instancer.CreateProtoIndicesAttr([0, 0, 1, 0, 0, 0])
    instancer.CreatePositionsAttr([Gf.Vec3f(k, 0, 0) for k in range(6)])
    instancer.CreateScalesAttr([Gf.Vec3f(1, 1, k + 1) for k in range(6)])
    half = np.sqrt(0.5)
    instancer.CreateOrientationsAttr(Vt.QuathArray([Gf.Quath(1, 0, 0, 0)] * 5 + [Gf.Quath(half, 0, 0, half)]))
    return instancer


def test_point_instancers(new_mesh):
    stage = stage_in()
    instancer = point_instancer(stage, new_mesh)
    instancer.AddTranslateOp().Set(Gf.Vec3d(0, 100, 0))
    scene = read_scene(stage)
    a, m0, m1 = scene.meshes
    assert (a.path, m0.path, m1.path) == ("/P/Protos/A", "/P/Protos/B/M0", "/P/Protos/B/M1")
    assert a.placements.shape == (5, 3, 4) and m0.placements is None
    square = np.array(SQUARE, dtype=float)
    found = placed_points(a)
    for copy, x in zip(found[:4], (0, 1, 3, 4), strict=True):
        np.testing.assert_allclose(copy, square + np.array([x, 100, 0]), atol=1e-9)
    turned = square[:, [1, 0, 2]] * [-1, 1, 1]
    np.testing.assert_allclose(found[4], turned + np.array([5, 100, 0]), atol=2e-3)  # half-precision quaternions
    # the prototype's own transform is scaled with the copy: z = 3 * 5
    np.testing.assert_allclose(m0.points, square + np.array([2, 100, 15]))
    np.testing.assert_allclose(m1.points, square + np.array([2, 101, 15]))
    assert scene.warnings == ()


def test_masked_copies(new_mesh):
    stage = stage_in()
    instancer = point_instancer(stage, new_mesh)
    instancer.CreateIdsAttr([10, 11, 12, 13, 14, 15])
    instancer.CreateInvisibleIdsAttr([12, 13])
    instancer.DeactivateId(14)
    copies = all_copies(read_scene(stage))
    np.testing.assert_allclose(sorted(copies[:2, 0, 0]), [0, 1])
    assert len(copies) == 3


def test_nested_instancers_and_native_instances_in_prototypes(new_mesh):
    stage = stage_in()
    inner = UsdGeom.PointInstancer.Define(stage, "/Outer/Protos/Inner")
    new_mesh(stage, "/Outer/Protos/Inner/M", SQUARE, [[0, 1, 2, 3]])
    inner.CreatePrototypesRel().SetTargets(["/Outer/Protos/Inner/M"])
    inner.CreateProtoIndicesAttr([0, 0])
    inner.CreatePositionsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(0, 1, 0)])
    outer = UsdGeom.PointInstancer.Define(stage, "/Outer")
    outer.CreatePrototypesRel().SetTargets(["/Outer/Protos/Inner"])
    outer.CreateProtoIndicesAttr([0, 0, 0])
    outer.CreatePositionsAttr([Gf.Vec3f(10 * k, 0, 0) for k in range(3)])
    UsdLux.SphereLight.Define(stage, "/Outer/Protos/Inner/M/Lamp")
    scene = read_scene(stage)
    (mesh,) = scene.meshes
    origins = placed_points(mesh)[:, 0]
    np.testing.assert_allclose(origins, [(x, y, 0) for x in (0, 10, 20) for y in (0, 1)], atol=1e-12)
    assert scene.lights == () and "lights and cameras are not copied" in scene.warnings[0]


def test_an_instancer_that_holds_itself(new_mesh):
    stage = stage_in()
    new_mesh(stage, "/Floor", SQUARE, [[0, 1, 2, 3]])
    instancer = point_instancer(stage, new_mesh)
    instancer.GetPrototypesRel().SetTargets(["/P", "/P/Protos/B"])
    scene = read_scene(stage)
    assert "the point instancer holds itself" in "\n".join(scene.warnings)
    with pytest.raises(UsdfabError, match="holds itself"):
        read_scene(stage, strict=True)


@pytest.mark.parametrize(
    ("break_it", "problem"),
    [
        (lambda p: p.CreateProtoIndicesAttr([0, 0, 7, 0, 0, 0]), "prototype 7 does not exist, there are 2"),
        (lambda p: p.CreatePositionsAttr([Gf.Vec3f(0)]), "6 prototype indices, but 0 positions"),
        (lambda p: p.GetPrototypesRel().SetTargets(["/P/Protos/A", "/Gone"]), "prototype /Gone does not exist"),
        (lambda p: p.CreatePositionsAttr([Gf.Vec3f(np.nan)] + [Gf.Vec3f(0)] * 5), "transform is not finite; 1 of 5"),
    ],
)
def test_bad_instancers(new_mesh, break_it, problem, capfd):
    stage = stage_in()
    new_mesh(stage, "/Floor", SQUARE, [[0, 1, 2, 3]])
    break_it(point_instancer(stage, new_mesh))
    scene = read_scene(stage)
    assert any(problem in w and "/P" in w for w in scene.warnings), scene.warnings
    assert np.isfinite(all_copies(scene)).all()
    with pytest.raises(UsdfabError, match=problem.split(";")[0]):
        read_scene(stage, strict=True)
    capfd.readouterr()


def test_copies_that_move(new_mesh):
    stage = stage_in()
    instancer = point_instancer(stage, new_mesh)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(9)
    positions = instancer.GetPositionsAttr()
    for time in (0.0, 10.0):
        positions.Set([Gf.Vec3f(k, time, 0) for k in range(6)], time)
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.CreateShutterOpenAttr(-0.5)
    camera.CreateShutterCloseAttr(0.5)
    a, m0, _ = read_scene(stage, time=4.0).meshes
    np.testing.assert_allclose((a.placements_close - a.placements)[:, :, 3], np.tile([0, 1, 0], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(m0.points_close - m0.points, np.tile([0, 1, 0], (4, 1)), atol=1e-6)
    assert m0.points[0, 1] == pytest.approx(3.5) and a.points_close is None
