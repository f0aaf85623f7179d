"""Fabrics turned and scaled on their surface: analytic frames, albedo maps that stay, copies that differ."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.orientation import ROTATION, SCALE, Orientation
from usdfab.usd.read_scene import read_scene

CLOTH = "/World/Cloth"


def author(stage, path, name, value, type_name=Sdf.ValueTypeNames.Double):
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path)).CreatePrimvar(name, type_name, "constant").Set(value)


def frames(mesh, meters):
    """(T, 3, 2): directions on the surface in which the weft and the warp run, metres per metre of cloth."""
    edges = mesh.points[mesh.triangles][:, 1:] - mesh.points[mesh.triangles][:, :1]
    cloth = (mesh.uv[:, 1:] - mesh.uv[:, :1]) * meters
    return np.linalg.solve(cloth, edges).transpose(0, 2, 1)


def read(stage):
    scene = read_scene(stage)
    return frames(scene.meshes[0], scene.fabrics[0].meters_per_uv)


@pytest.mark.parametrize(
    ("degrees", "weft", "warp"),
    [
        (0.0, (1, 0, 0), (0, 1, 0)),
        (90.0, (0, 1, 0), (-1, 0, 0)),
        (180.0, (-1, 0, 0), (0, -1, 0)),
        (-90.0, (0, -1, 0), (1, 0, 0)),
        (450.0, (0, 1, 0), (-1, 0, 0)),
        (30.0, (np.sqrt(0.75), 0.5, 0), (-0.5, np.sqrt(0.75), 0)),
    ],
)
def test_weft_and_warp_turn_from_u_towards_v(cloth_stage, degrees, weft, warp):
    author(cloth_stage, CLOTH, ROTATION, degrees)
    found = read(cloth_stage)
    np.testing.assert_allclose(found[..., 0], np.broadcast_to(weft, (2, 3)), atol=1e-6)
    np.testing.assert_allclose(found[..., 1], np.broadcast_to(warp, (2, 3)), atol=1e-6)


def test_a_quarter_turn_swaps_the_axes_exactly(cloth_stage):
    plain = read_scene(cloth_stage).meshes[0].uv
    author(cloth_stage, CLOTH, ROTATION, 90.0)
    turned = read_scene(cloth_stage).meshes[0].uv
    np.testing.assert_array_equal(turned, np.stack([plain[..., 1], -plain[..., 0]], axis=-1))


@given(st.floats(-720, 720), st.floats(-5, 5), st.floats(-5, 5))
def test_turning_is_a_rotation(degrees, u, v):
    orientation = Orientation(degrees)
    np.testing.assert_allclose(orientation.matrix @ orientation.matrix.T, np.eye(2), atol=1e-14)
    back = Orientation(-degrees).turned(orientation.turned(np.array([u, v])))
    np.testing.assert_allclose(back, (u, v), atol=1e-12)


def test_scale_makes_yarns_larger_and_leaves_the_surface(cloth_stage):
    before = read_scene(cloth_stage).fabrics[0].meters_per_uv
    author(cloth_stage, "/World", SCALE, 4.0, Sdf.ValueTypeNames.Float)
    scene = read_scene(cloth_stage)
    assert scene.fabrics[0].meters_per_uv == pytest.approx(before / 4)
    # A metre of cloth covers four of the surface.
    np.testing.assert_allclose(np.linalg.norm(read(cloth_stage), axis=1), 4.0, rtol=1e-6)


def test_what_is_authored_nearest_counts(cloth_stage):
    author(cloth_stage, "/World", ROTATION, 10.0)
    author(cloth_stage, CLOTH, ROTATION, 90.0)
    np.testing.assert_allclose(read(cloth_stage)[0, :, 0], (0, 1, 0), atol=1e-6)


def test_an_albedo_map_stays_where_it_lies(cloth_stage, tmp_path):
    image = tmp_path / "map.png"
    image.write_bytes(b"not opened while a scene is read")
    material = cloth_stage.GetPrimAtPath("/World/Looks/Fabric")
    material.GetAttribute("usdfab:albedoMap").Set(Sdf.AssetPath(str(image)))

    def looked_up():
        scene = read_scene(cloth_stage)
        uv = scene.meshes[0].uv
        return np.concatenate([uv, np.ones((2, 3, 1))], axis=-1) @ scene.fabrics[0].albedo_map.uv_transform.T

    before = looked_up()
    author(cloth_stage, CLOTH, ROTATION, 37.0)
    np.testing.assert_allclose(looked_up(), before, atol=1e-12)


def test_subsets_turn_on_their_own(new_mesh, cloth_stage):
    points = [(x, y, 0) for y in (0, 1) for x in (0, 1, 2)]
    mesh = new_mesh(cloth_stage, "/World/Two", points, [[0, 1, 4, 3], [1, 2, 5, 4]], [(x, y) for x, y, _ in points])
    cloth_stage.RemovePrim(CLOTH)
    api = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    material = UsdShade.Material(cloth_stage.GetPrimAtPath("/World/Looks/Fabric"))
    for name, faces in (("Left", [0]), ("Right", [1])):
        subset = api.CreateMaterialBindSubset(name, faces)
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    author(cloth_stage, "/World/Two/Right", ROTATION, 90.0)
    scene = read_scene(cloth_stage)
    weft = frames(scene.meshes[0], scene.fabrics[0].meters_per_uv)[..., 0]
    right = scene.meshes[0].points[scene.meshes[0].triangles][..., 0].mean(axis=1) > 1
    np.testing.assert_allclose(weft[~right], [(1, 0, 0)] * 2, atol=1e-6)
    np.testing.assert_allclose(weft[right], [(0, 1, 0)] * 2, atol=1e-6)


def test_instances_of_one_mesh_may_be_turned_differently(cloth_stage, tmp_path):
    part = tmp_path / "part.usda"
    cloth_stage.Export(str(part))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for number in range(6):
        prim = UsdGeom.Xform.Define(stage, f"/Copy{number}").GetPrim()
        prim.GetReferences().AddReference(str(part), "/World")
        prim.SetInstanceable(True)
        UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(2 * number, 0, 0))
    author(stage, "/Copy5", ROTATION, 90.0)
    scene = read_scene(stage)
    # Five together as placements, one of its own.
    assert sorted(len(m.placements) if m.placements is not None else 1 for m in scene.meshes) == [1, 5]
    (alone,) = [m for m in scene.meshes if m.placements is None]
    assert alone.path == "/Copy5/Cloth"
    np.testing.assert_allclose(frames(alone, 2.0)[0, :, 0], (0, 1, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "type_name", "value", "problem"),
    [
        (ROTATION, Sdf.ValueTypeNames.Double, float("nan"), "finite"),
        (ROTATION, Sdf.ValueTypeNames.String, "a bit", "expected a number"),
        (ROTATION, Sdf.ValueTypeNames.DoubleArray, [1.0, 2.0], "one finite"),
        (SCALE, Sdf.ValueTypeNames.Double, 0.0, "not above 0"),
        (SCALE, Sdf.ValueTypeNames.Double, -1.0, "not above 0"),
    ],
)
def test_nonsense_is_named_and_left_out(cloth_stage, name, type_name, value, problem):
    plain = read(cloth_stage)
    author(cloth_stage, CLOTH, name, value, type_name)
    with pytest.raises(UsdfabError, match=problem):
        read_scene(cloth_stage, strict=True)
    scene = read_scene(cloth_stage)
    assert any(problem in w and "not turned or scaled" in w for w in scene.warnings)
    np.testing.assert_array_equal(read(cloth_stage), plain)
