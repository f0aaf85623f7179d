"""Reading stages: units, transforms, primvars, materials, fabrics, cameras, and what is wrong with bad stages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.usd.fabric_io import write_fabric
from usdfab.usd.read_scene import read_scene

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
UV = [(x, y) for x, y, _ in SQUARE]


def areas(mesh):
    p = mesh.points[mesh.triangles]
    return 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def empty_stage(meters=1.0):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    return stage


# --- the whole -------------------------------------------------------------------------------------------------------


def test_cloth(cloth_stage, fabric):
    scene = read_scene(cloth_stage)
    (mesh,) = scene.meshes
    assert mesh.path == "/World/Cloth"
    assert mesh.triangles.dtype == np.int32 and mesh.points.dtype == np.float64
    assert mesh.normals is None and mesh.uv.shape == (2, 3, 2)
    (surface,) = scene.fabrics
    assert surface.fabric == fabric
    assert surface.path == "/World/Looks/Fabric"
    assert surface.meters_per_uv == pytest.approx(2.0)
    assert scene.materials[mesh.face_material[0]].fabric == 0
    assert scene.up_axis == "Z" and scene.warnings == ()
    camera = scene.cameras[0]
    np.testing.assert_allclose(camera.to_world[:3, 3], [0.5, 0.5, 2])
    np.testing.assert_allclose(camera.tan_half, [20.955 / 100, 15.2908 / 100], rtol=1e-6)


def build(new_mesh, fabric, meters):
    """The same physical scene in a stage of any unit."""
    from usdfab.usd.fabric_io import define_fabric_material

    s = 1.0 / meters
    stage = empty_stage(meters)
    root = UsdGeom.Xform.Define(stage, "/World")
    root.AddTranslateOp().Set(Gf.Vec3d(0.1 * s, 0.2 * s, 0.3 * s))
    root.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30))
    mesh = new_mesh(stage, "/World/Cloth", [(x * s, y * s, z * s) for x, y, z in SQUARE], [[0, 1, 2, 3]], UV)
    material = define_fabric_material(stage, "/World/F", fabric)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    UsdGeom.Camera.Define(stage, "/World/Camera").AddTranslateOp().Set(Gf.Vec3d(0, 0, 2 * s))
    point = UsdLux.SphereLight.Define(stage, "/World/Point")
    point.CreateRadiusAttr(0.1 * s)
    point.CreateTreatAsPointAttr(True)
    point.AddTranslateOp().Set(Gf.Vec3d(0, 0, s))
    UsdLux.SphereLight.Define(stage, "/World/Sphere").CreateRadiusAttr(0.2 * s)
    rect = UsdLux.RectLight.Define(stage, "/World/Rect")
    rect.CreateWidthAttr(0.3 * s)
    rect.CreateHeightAttr(0.4 * s)
    UsdLux.DistantLight.Define(stage, "/World/Sun")
    return stage


def assert_same(a, b):
    for name in a.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, (np.ndarray, float)):
            np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-7)
        elif name not in ("fabric", "path"):
            assert x == y, name


def test_a_stage_in_centimetres_is_the_same_scene(new_mesh, fabric):
    metres, centimetres = (read_scene(build(new_mesh, fabric, m)) for m in (1.0, 0.01))
    for group in ("meshes", "cameras", "lights", "materials", "fabrics"):
        ours, theirs = getattr(metres, group), getattr(centimetres, group)
        assert len(ours) == len(theirs) > 0
        for a, b in zip(ours, theirs, strict=True):
            assert_same(a, b)


def test_transforms_stack(new_mesh):
    stage = empty_stage()
    outer = UsdGeom.Xform.Define(stage, "/A")
    outer.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    outer.AddRotateZOp().Set(90.0)
    mesh = new_mesh(stage, "/A/M", SQUARE, [[0, 1, 2, 3]])
    UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(2, 3, 1))
    points = read_scene(stage).meshes[0].points
    np.testing.assert_allclose(points, [(0, 0, 5), (0, 2, 5), (-3, 2, 5), (-3, 0, 5)], atol=1e-6)


# --- meshes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_winding(new_mesh, left_handed, mirrored):
    stage = empty_stage()
    # in space the front shows to local +z: right-handed counter-clockwise, left-handed clockwise
    face = [3, 2, 1, 0] if left_handed else [0, 1, 2, 3]
    mesh = new_mesh(stage, "/M", SQUARE, [face], UV)
    mesh.CreateOrientationAttr("leftHanded" if left_handed else "rightHanded")
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    if mirrored:
        UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    read = read_scene(stage).meshes[0]
    np.testing.assert_allclose(areas(read).sum(axis=0), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(read.normals, np.broadcast_to([0, 0, 1], (2, 3, 3)))
    # attributes follow the corners when the winding turns
    x = read.points[read.triangles][..., 0] * (-1 if mirrored else 1)
    np.testing.assert_allclose(read.uv[..., 0], x)


def test_normals_turn_with_the_inverse_transpose(new_mesh):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    mesh.CreateNormalsAttr([Gf.Vec3f(1, 0, 1)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(2, 1, 1))
    normal = read_scene(stage).meshes[0].normals[0, 0]
    np.testing.assert_allclose(normal, np.array([0.5, 0, 1]) / math.sqrt(1.25), rtol=1e-6)


@pytest.mark.parametrize("interpolation", ["vertex", "varying", "faceVarying", "uniform"])
def test_normal_interpolations(new_mesh, interpolation):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2], [0, 2, 3]])
    number = {"vertex": 4, "varying": 4, "faceVarying": 6, "uniform": 2}[interpolation]
    mesh.CreateNormalsAttr([Gf.Vec3f(i, 0, 1) for i in range(number)])
    mesh.SetNormalsInterpolation(interpolation)
    found = read_scene(stage).meshes[0].normals
    slope = np.round(found[..., 0] / found[..., 2]).astype(int).tolist()
    expected = {"faceVarying": [[0, 1, 2], [3, 4, 5]], "uniform": [[0, 0, 0], [1, 1, 1]]}
    assert slope == expected.get(interpolation, [[0, 1, 2], [0, 2, 3]])


def test_subdivision_cages_get_smooth_normals(new_mesh):
    stage = empty_stage()
    roof = [(-1, 0, 0), (0, 0, 1), (0, 1, 1), (-1, 1, 0), (1, 0, 0), (1, 1, 0)]
    mesh = new_mesh(stage, "/M", roof, [[0, 1, 2, 3], [1, 4, 5, 2]])
    assert read_scene(stage).meshes[0].normals is None
    mesh.GetSubdivisionSchemeAttr().Set("catmullClark")
    read = read_scene(stage, subdivision=0).meshes[0]
    ridge = np.isin(read.triangles, [1, 2])
    lengths = np.linalg.norm(read.normals, axis=2)
    np.testing.assert_allclose(lengths, 1)
    assert np.abs(read.normals[ridge][:, 0]).max() < 0.4
    np.testing.assert_allclose(np.abs(read.normals[~ridge][:, 0]), math.sqrt(0.5))


def test_indexed_face_varying_uv_under_another_name(new_mesh):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    api = UsdGeom.PrimvarsAPI(mesh)
    api.CreatePrimvar("lightmap", Sdf.ValueTypeNames.Color3fArray, "constant").Set([Gf.Vec3f(1)])
    uv = api.CreatePrimvar("unwrap", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    uv.Set([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1)])
    uv.SetIndices(Vt.IntArray([0, 1, 2, 0]))
    np.testing.assert_allclose(read_scene(stage).meshes[0].uv[1], [(0, 0), (1, 1), (0, 0)])
    uv.SetIndices(Vt.IntArray([0, 1, 2, 7]))
    with pytest.raises(UsdfabError, match=r"unwrap:indices>: an index is out of range"):
        read_scene(stage, strict=True)
    scene = read_scene(stage)
    assert scene.meshes[0].uv is None
    assert "/M.primvars:unwrap:indices>: an index is out of range" in scene.warnings[0]


def test_holes_and_slivers_are_left_out(new_mesh):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2], [0, 2, 3], [0, 1]])
    mesh.CreateHoleIndicesAttr([0])
    scene = read_scene(stage)
    assert scene.meshes[0].triangles.tolist() == [[0, 2, 3]]
    assert "1 faces of fewer than three corners" in scene.warnings[0]


def test_time(new_mesh):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    move = UsdGeom.Xformable(mesh).AddTranslateOp()
    move.Set(Gf.Vec3d(0, 0, 1), 1.0)
    move.Set(Gf.Vec3d(0, 0, 3), 3.0)
    assert read_scene(stage).meshes[0].points[0, 2] == 1
    assert read_scene(stage, time=2.0).meshes[0].points[0, 2] == 2
    stage.SetStartTimeCode(3)
    stage.SetEndTimeCode(5)
    assert read_scene(stage).meshes[0].points[0, 2] == 3
    with pytest.raises(UsdfabError, match="not a time code"):
        read_scene(stage, time=math.nan)


# --- what is read ----------------------------------------------------------------------------------------------------


def test_visibility_purpose_activation(new_mesh):
    stage = empty_stage()
    for name in ("Seen", "Hidden", "Guide", "Proxy", "Render", "Off"):
        new_mesh(stage, f"/{name}", SQUARE, [[0, 1, 2, 3]])
    group = UsdGeom.Xform.Define(stage, "/Group")
    new_mesh(stage, "/Group/Below", SQUARE, [[0, 1, 2, 3]])
    group.MakeInvisible()
    UsdLux.SphereLight.Define(stage, "/Group/Lamp")
    UsdGeom.Imageable(stage.GetPrimAtPath("/Hidden")).MakeInvisible()
    for name in ("guide", "proxy", "render"):
        UsdGeom.Imageable(stage.GetPrimAtPath(f"/{name.title()}")).CreatePurposeAttr(name)
    stage.GetPrimAtPath("/Off").SetActive(False)
    scene = read_scene(stage)
    assert {m.path for m in scene.meshes} == {"/Seen", "/Render"}
    assert scene.lights == ()
    scene = read_scene(stage, purposes=("default", "proxy"))
    assert {m.path for m in scene.meshes} == {"/Seen", "/Proxy"}


def test_instances(new_mesh):
    stage = empty_stage()
    stage.CreateClassPrim("/_Proto")
    new_mesh(stage, "/_Proto/M", SQUARE, [[0, 1, 2, 3]])
    for k in range(3):
        prim = stage.DefinePrim(f"/I{k}", "Xform")
        prim.GetReferences().AddInternalReference("/_Proto")
        prim.SetInstanceable(True)
        UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(k, 0, 0))
    scene = read_scene(stage)
    assert [m.path for m in scene.meshes] == ["/I0/M", "/I1/M", "/I2/M"]
    assert [m.points[0, 0] for m in scene.meshes] == [0, 1, 2]


def test_what_is_left_out_is_named(new_mesh):
    stage = empty_stage()
    new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    UsdGeom.Sphere.Define(stage, "/S1")
    UsdGeom.Sphere.Define(stage, "/S2")
    UsdGeom.PointInstancer.Define(stage, "/P")
    new_mesh(stage, "/P/Prototype", SQUARE, [[0, 1, 2, 3]])
    new_mesh(stage, "/Empty", [], [])
    UsdLux.GeometryLight.Define(stage, "/Lamp")
    UsdGeom.Camera.Define(stage, "/Ortho").CreateProjectionAttr("orthographic")
    scene = read_scene(stage, placements=False)
    assert len(scene.meshes) == 1 and scene.lights == () and scene.cameras == ()
    text = "\n".join(scene.warnings)
    for part in ("2 prims of type Sphere", "1 prims of type PointInstancer", "/Empty", "GeometryLight", "/Ortho"):
        assert part in text


def test_broken_references_are_reported(new_mesh, capfd):
    stage = empty_stage()
    new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    stage.DefinePrim("/R").GetReferences().AddReference("/nowhere/missing.usda")
    assert "missing.usda" in read_scene(stage).warnings[0]
    capfd.readouterr()


# --- cameras ---------------------------------------------------------------------------------------------------------


def test_camera_values(cloth_stage):
    camera = UsdGeom.Camera(cloth_stage.GetPrimAtPath("/World/Camera"))
    camera.CreateFocalLengthAttr(20.0)
    camera.CreateHorizontalApertureAttr(40.0)
    camera.CreateVerticalApertureAttr(20.0)
    camera.CreateHorizontalApertureOffsetAttr(10.0)
    camera.CreateExposureAttr(1.5)
    camera.AddScaleOp().Set(Gf.Vec3f(7))
    read = read_scene(cloth_stage).cameras[0]
    np.testing.assert_allclose(read.tan_half, [1, 0.5])
    np.testing.assert_allclose(read.offset, [0.5, 0])
    assert read.exposure == pytest.approx(1.5)
    np.testing.assert_allclose(read.to_world[:3, :3], np.eye(3), atol=1e-12)
    camera.GetFocalLengthAttr().Set(0.0)
    with pytest.raises(UsdfabError, match="/World/Camera>: focal length"):
        read_scene(cloth_stage, strict=True)
    scene = read_scene(cloth_stage)
    assert scene.cameras == () and "the camera is left out" in scene.warnings[0]
    # nothing can stand in for a camera that was asked for
    with pytest.raises(UsdfabError, match="/World/Camera>: focal length"):
        read_scene(cloth_stage, camera="/World/Camera")


def test_the_chosen_camera_comes_first(cloth_stage):
    UsdGeom.Camera.Define(cloth_stage, "/World/Second")
    assert [c.path for c in read_scene(cloth_stage).cameras] == ["/World/Camera", "/World/Second"]
    assert read_scene(cloth_stage, camera="/World/Second").cameras[0].path == "/World/Second"
    with pytest.raises(UsdfabError, match=r"</Nope>: there is no such camera; choose one of /World/Camera"):
        read_scene(cloth_stage, camera="/Nope")


# --- materials -------------------------------------------------------------------------------------------------------


def preview(stage, path, **inputs):
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/S")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in inputs.items():
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
        shader.CreateInput(name, kind).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material, shader


def bind(mesh, material):
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def test_preview_surface(new_mesh):
    stage = empty_stage()
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]])
    material, shader = preview(stage, "/P", diffuseColor=Gf.Vec3f(0.25, 0.5, 1), roughness=0.25, metallic=1.0)
    bind(mesh, material)
    read = read_scene(stage).materials[0]
    np.testing.assert_allclose(read.base_color, [0.25, 0.5, 1])
    assert (read.path, read.fabric, read.roughness, read.metallic, read.opacity) == ("/P", -1, 0.25, 1.0, 1.0)
    # through the material's interface
    color = material.CreateInput("tint", Sdf.ValueTypeNames.Color3f)
    color.Set(Gf.Vec3f(1, 0, 0))
    shader.GetInput("diffuseColor").ConnectToSource(color)
    np.testing.assert_allclose(read_scene(stage).materials[0].base_color, [1, 0, 0])
    # a texture counts with its fallback, and that is said
    texture = UsdShade.Shader.Define(stage, "/P/T")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(0, 0.5, 0, 1))
    shader.GetInput("diffuseColor").ConnectToSource(texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    scene = read_scene(stage)
    np.testing.assert_allclose(scene.materials[0].base_color, [0, 0.5, 0])
    assert "diffuseColor comes from /P/T, which names no image" in scene.warnings[0]


def test_display_color_else_grey(new_mesh):
    stage = empty_stage()
    new_mesh(stage, "/A", SQUARE, [[0, 1, 2, 3]])
    colored = new_mesh(stage, "/B", SQUARE, [[0, 1, 2, 3]])
    colored.CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0), Gf.Vec3f(0, 0, 1)])
    grey, mean = read_scene(stage).materials
    np.testing.assert_allclose(grey.base_color, 0.5)
    np.testing.assert_allclose(mean.base_color, [0.5, 0, 0.5])


def test_subsets(new_mesh, cloth_stage):
    mesh = new_mesh(cloth_stage, "/World/Two", SQUARE, [[0, 1, 2], [0, 2, 3]], [(2 * u, 2 * v) for u, v in UV])
    red, _ = preview(cloth_stage, "/World/Looks/Red", diffuseColor=Gf.Vec3f(1, 0, 0))
    bind(mesh, red)
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", Vt.IntArray([1]), "materialBind")
    bind(subset, UsdShade.Material(cloth_stage.GetPrimAtPath("/World/Looks/Fabric")))
    scene = read_scene(cloth_stage)
    two = next(m for m in scene.meshes if m.path == "/World/Two")
    looks = [scene.materials[i] for i in two.face_material]
    assert [m.path for m in looks] == ["/World/Looks/Red", "/World/Looks/Fabric"]
    # one FabricSurface for each mesh: 2 m per uv on the first, 0.5 m on the second
    assert [f.meters_per_uv for f in scene.fabrics] == pytest.approx([2.0, 0.5])
    assert looks[1].fabric == 1
    subset.GetIndicesAttr().Set(Vt.IntArray([5]))
    with pytest.raises(UsdfabError, match=r"part.indices>: a face index is out of range"):
        read_scene(cloth_stage, strict=True)
    scene = read_scene(cloth_stage)
    two = next(m for m in scene.meshes if m.path == "/World/Two")
    assert [scene.materials[i].path for i in two.face_material] == ["/World/Looks/Red"] * 2
    assert "part.indices>: a face index is out of range" in scene.warnings[0]


# --- fabrics ---------------------------------------------------------------------------------------------------------


def test_meters_per_uv_of_a_bent_mesh(new_mesh, fabric):
    # a quarter of a cylinder of radius 2 and length 3, uv in units of 1.5 m along it and of the arc across
    stage = empty_stage()
    n = 400
    angle = np.linspace(0, math.pi / 2, n + 1)
    arc = np.stack([2 * np.cos(angle), 2 * np.sin(angle)], axis=1)
    points = [(x, y, z) for z in (0, 3) for x, y in arc]
    faces = [[i, i + 1, n + 2 + i, n + 1 + i] for i in range(n)]
    uv = [(a * 2 / 1.5, z / 1.5) for z in (0, 3) for a in angle]
    new_mesh(stage, "/M", points, faces, uv)
    scene = read_scene(stage, fabric_override=fabric)
    assert scene.fabrics[0].meters_per_uv == pytest.approx(1.5, rel=1e-5)


def test_authored_meters_per_uv_wins(cloth_stage):
    cloth_stage.GetPrimAtPath("/World/Looks/Fabric").GetAttribute("usdfab:metersPerUv").Set(0.125)
    UsdGeom.SetStageMetersPerUnit(cloth_stage, 0.01)
    assert read_scene(cloth_stage).fabrics[0].meters_per_uv == 0.125


def test_override_replaces_bound_fabrics(cloth_stage, new_mesh):
    new_mesh(cloth_stage, "/World/Floor", SQUARE, [[0, 1, 2, 3]], UV)
    satin = preset("silk-satin")
    scene = read_scene(cloth_stage, fabric_override=satin)
    assert [f.fabric for f in scene.fabrics] == [satin]
    assert sum(m.fabric >= 0 for m in scene.materials) == 1


def test_override_without_bound_fabric(new_mesh, fabric):
    stage = empty_stage()
    new_mesh(stage, "/Free", SQUARE, [[0, 1, 2, 3]], UV)
    new_mesh(stage, "/Plain", SQUARE, [[0, 1, 2, 3]])
    taken = new_mesh(stage, "/Taken", SQUARE, [[0, 1, 2, 3]], UV)
    bind(taken, preview(stage, "/P", diffuseColor=Gf.Vec3f(1, 0, 0))[0])
    scene = read_scene(stage, fabric_override=fabric)
    clothed = [m.path for m in scene.meshes if scene.materials[m.face_material[0]].fabric >= 0]
    assert clothed == ["/Free"]
    # nothing free: the only mesh with uv is the cloth
    stage.RemovePrim("/Free")
    scene = read_scene(stage, fabric_override=fabric)
    assert [m.path for m in scene.meshes if scene.materials[m.face_material[0]].fabric >= 0] == ["/Taken"]
    # two candidates: ask
    other = new_mesh(stage, "/Other", SQUARE, [[0, 1, 2, 3]], UV)
    bind(other, preview(stage, "/Q", diffuseColor=Gf.Vec3f(1, 0, 0))[0])
    with pytest.raises(UsdfabError, match=r"which mesh is cloth\? .*\(/Taken, /Other\).*usdfab bind"):
        read_scene(stage, fabric_override=fabric)
    stage.RemovePrim("/Taken")
    stage.RemovePrim("/Other")
    # the only mesh is the cloth also without texture coordinates
    assert len(read_scene(stage, fabric_override=fabric).fabrics) == 1
    new_mesh(stage, "/Plain2", SQUARE, [[0, 1, 2, 3]])
    with pytest.raises(UsdfabError, match="no mesh has texture coordinates"):
        read_scene(stage, fabric_override=fabric)


def test_bad_fabric_values_are_located(cloth_stage):
    cloth_stage.GetPrimAtPath("/World/Looks/Fabric").GetAttribute("usdfab:yarn:warp:ior").Set(0.5)
    with pytest.raises(UsdfabError, match=r"</World/Looks/Fabric.usdfab:yarn:warp:ior>: 0.5 is not between 1.01 and 3"):
        read_scene(cloth_stage, strict=True)
    # without strict, the cloth has its preview surface
    scene = read_scene(cloth_stage)
    assert scene.fabrics == () and scene.materials[0].path == "/World/Looks/Fabric"
    assert "warp:ior>: 0.5 is not between 1.01 and 3; the cloth is shown without fibers" in scene.warnings[0]


# --- bad stages ------------------------------------------------------------------------------------------------------


def test_stages_without_meshes(tmp_path, fabric):
    with pytest.raises(UsdfabError, match="the stage is empty"):
        read_scene(Usd.Stage.CreateInMemory())
    with pytest.raises(UsdfabError, match="no visible mesh"):
        read_scene(write_fabric(fabric, tmp_path / "f.usda"))
    with pytest.raises(UsdfabError, match="does not exist"):
        read_scene(tmp_path / "none.usda")


BAD_MESHES = {
    "points": (Vt.Vec3fArray([Gf.Vec3f(0, 0, math.nan)] * 4), "point 0 is not finite"),
    "faceVertexIndices": (Vt.IntArray([0, 1, 2, 4]), "index 4 is out of range, there are 4 points"),
    "faceVertexCounts": (Vt.IntArray([5]), "ask for 5 indices, there are 4"),
    "primvars:st": ([Gf.Vec2f(0, 0)] * 3, "3 values for vertex interpolation, expected 4"),
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_bad_meshes(cloth_stage, new_mesh, name):
    value, problem = BAD_MESHES[name]
    cloth_stage.GetPrimAtPath("/World/Cloth").GetAttribute(name).Set(value)
    with pytest.raises(UsdfabError, match=problem) as caught:
        read_scene(cloth_stage, strict=True)
    assert caught.value.place.endswith(f"</World/Cloth.{name}>")
    if name != "primvars:st":
        with pytest.raises(UsdfabError, match=f"no mesh can be drawn: .*{problem}"):
            read_scene(cloth_stage)
    new_mesh(cloth_stage, "/World/Floor", SQUARE, [[0, 1, 2, 3]])
    scene = read_scene(cloth_stage)
    expected = ["/World/Cloth", "/World/Floor"] if name == "primvars:st" else ["/World/Floor"]
    assert [m.path for m in scene.meshes] == expected
    assert f"</World/Cloth.{name}>: " in scene.warnings[0] and problem in scene.warnings[0]


def test_singular_transforms_leave_the_mesh_out(cloth_stage, new_mesh):
    flat = new_mesh(cloth_stage, "/World/Flat", SQUARE, [[0, 1, 2, 3]])
    UsdGeom.Xformable(flat).AddScaleOp().Set(Gf.Vec3f(1, 0, 1))
    scene = read_scene(cloth_stage)
    assert [m.path for m in scene.meshes] == ["/World/Cloth"]
    assert "/World/Flat>: the transform is singular; the mesh is left out" in scene.warnings[0]
    with pytest.raises(UsdfabError, match="/World/Flat>: the transform is singular"):
        read_scene(cloth_stage, strict=True)


def test_degenerate_meshes_and_transforms_without_numbers(cloth_stage, new_mesh):
    new_mesh(cloth_stage, "/World/Line", [(0, 0, 0), (1, 0, 0), (2, 0, 0)], [[0, 1, 2]])
    lost = new_mesh(cloth_stage, "/World/Lost", SQUARE, [[0, 1, 2, 3]])
    UsdGeom.Xformable(lost).AddTranslateOp().Set(Gf.Vec3d(math.nan, 0, 0))
    scene = read_scene(cloth_stage)
    assert [m.path for m in scene.meshes] == ["/World/Cloth"]
    text = "\n".join(scene.warnings)
    assert "/World/Line>: the mesh has no area; the mesh is left out" in text
    assert "/World/Lost>: the transform is not finite; the mesh is left out" in text
    for path, problem in (("/World/Line", "no area"), ("/World/Lost", "not finite")):
        cloth_stage.GetPrimAtPath("/World/Line").SetActive(path == "/World/Line")
        with pytest.raises(UsdfabError, match=f"{path}>: .*{problem}"):
            read_scene(cloth_stage, strict=True)


NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.5, 3.0, 1e30, math.nan, math.inf])
INDICES = st.lists(st.integers(-2, 9), max_size=12)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    points=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), max_size=8),
    counts=st.lists(st.integers(-1, 5), max_size=4),
    indices=INDICES,
    uv=st.lists(st.tuples(NUMBERS, NUMBERS), max_size=8),
    holes=INDICES,
    interpolation=st.sampled_from(["vertex", "faceVarying", "constant", "uniform", "nonsense"]),
    scheme=st.sampled_from(["none", "catmullClark", "loop", "bilinear"]),
    scale=st.tuples(NUMBERS, NUMBERS, NUMBERS),
    bound=st.booleans(),
)
def test_nonsense_never_crashes(
    cloth_stage, new_mesh, points, counts, indices, uv, holes, interpolation, scheme, scale, bound
):
    cloth_stage.RemovePrim("/World/Bad")
    mesh = UsdGeom.Mesh.Define(cloth_stage, "/World/Bad")
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points])
    mesh.CreateFaceVertexCountsAttr(counts)
    mesh.CreateFaceVertexIndicesAttr(indices)
    mesh.CreateHoleIndicesAttr(holes)
    mesh.CreateCreaseIndicesAttr(indices)
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([3.0])
    mesh.CreateSubdivisionSchemeAttr(scheme)
    UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(*scale))
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray)
    primvar.GetAttr().SetMetadata("interpolation", interpolation)
    primvar.Set([Gf.Vec2f(*c) for c in uv])
    if bound:
        bind(mesh, UsdShade.Material(cloth_stage.GetPrimAtPath("/World/Looks/Fabric")))
    scene = read_scene(cloth_stage)
    assert scene.meshes[0].path == "/World/Cloth"
    for found in scene.meshes:
        assert np.isfinite(found.points).all()
        assert found.triangles.max() < len(found.points)
    # what is drawn without a word when tolerant is no error when strict, and the other way round
    try:
        strict = read_scene(cloth_stage, strict=True)
    except UsdfabError as error:
        assert scene.warnings and error.problem in " ".join(scene.warnings)
    else:
        assert len(strict.meshes) == len(scene.meshes)


def test_attributes_of_another_type(cloth_stage):
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(
        """#usda 1.0
        over "World" {
            def Mesh "Bad" {
                string[] points = ["a"]
                int[] faceVertexCounts = [3]
                float[] faceVertexIndices = [0.5, 1, 2]
                string primvars:st = "uv"
                bool doubleSided = 1
            }
            def Mesh "Worse"
            {
                string subdivisionScheme = "none"
                double3 points = (1, 2, 3)
                int[] faceVertexCounts = [3]
                int[] faceVertexIndices = [0, 0, 0]
            }
            def Camera "Odd"
            {
                string focalLength = "long"
            }
            def SphereLight "Lamp"
            {
                string inputs:radius = "big"
                asset inputs:intensity = @x@
            }
        }"""
    )
    cloth_stage.GetRootLayer().subLayerPaths.append(layer.identifier)
    scene = read_scene(cloth_stage)
    assert [m.path for m in scene.meshes] == ["/World/Cloth"]
    assert len(scene.warnings) >= 2


def test_scene_is_plain_data():
    import usdfab.usd.scene as module

    assert "pxr" not in vars(module)
