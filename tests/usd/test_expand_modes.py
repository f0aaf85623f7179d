"""The three modes of expansion on all kinds of stages: valid files, the right places, meshes, instances and subsets."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers.tiles import tile_variants
from usdfab.usd.check import check
from usdfab.usd.expand import ExpandOptions, expand, world_curves
from usdfab.usd.fabric_io import define_fabric_material

OPTIONS = ExpandOptions(vertices_per_segment=6)
MODES = ("instancer", "xform", "baked")
YARN = YarnParameters(count=10, radius=2e-4, fiber_count=4)
SMALL = FabricParameters(size=(1e-2, 1e-2), warp=YARN, weft=YARN)
SQUARE = [(0, 0, 0), (0.02, 0, 0), (0.02, 0.02, 0), (0, 0.02, 0)]
UV = [(50 * x, 50 * y) for x, y, _ in SQUARE]


def new_stage(path: Path) -> Usd.Stage:
    """Metres, z up, with a fabric at /World/Looks/Fabric."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetMetadata("kilogramsPerUnit", 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    UsdGeom.Scope.Define(stage, "/World/Looks")
    define_fabric_material(stage, "/World/Looks/Fabric", SMALL)
    return stage


def bind(stage: Usd.Stage, mesh, material: str = "/World/Looks/Fabric") -> None:
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material(stage.GetPrimAtPath(material)))


@pytest.fixture
def cloth(tmp_path, new_mesh) -> Path:
    """A bent cloth of 2 cm x 2 cm."""
    stage = new_stage(tmp_path / "cloth.usdc")
    line = np.linspace(0, 0.02, 9)
    points = [(x, y, 10 * x * y) for y in line for x in line]
    faces = [[9 * j + i, 9 * j + i + 1, 9 * j + i + 10, 9 * j + i + 9] for j in range(8) for i in range(8)]
    mesh = new_mesh(stage, "/World/Cloth", points, faces, [(50 * x, 50 * y) for x, y, _ in points])
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * len(points))
    bind(stage, mesh)
    stage.Save()
    return tmp_path / "cloth.usdc"


@pytest.mark.parametrize("mode", MODES)
def test_files_are_valid(cloth, tmp_path, mode):
    result = expand(cloth, tmp_path / "fibers.usdc", options=replace(OPTIONS, mode=mode))
    assert result.mode == mode and result.curves > 0 and result.warnings == ()
    assert {issue.rule for issue in check(result.path)} <= {"usdfab:fiberRadius", "usdfab:unusual"}  # few, thick fibers
    nvidia = pytest.importorskip("usd_validation_nvidia")
    logging.disable(logging.WARNING)
    issues = nvidia.ValidationEngine().validate(str(result.path)).issues()
    logging.disable(logging.NOTSET)
    assert [str(i) for i in issues] == []


@pytest.mark.parametrize("mode", MODES)
def test_what_every_mode_authors(cloth, tmp_path, mode):
    path = expand(cloth, tmp_path / "fibers.usdc", options=replace(OPTIONS, mode=mode)).path
    stage = Usd.Stage.Open(str(path))
    root = stage.GetPrimAtPath("/World/Cloth_fibers")
    assert Usd.ModelAPI(root).GetKind() == "subcomponent"
    curves = [UsdGeom.BasisCurves(p) for p in Usd.PrimRange.AllPrims(root) if p.IsA(UsdGeom.BasisCurves)]
    assert curves
    for c in curves:
        assert (c.GetBasisAttr().Get(), c.GetWrapAttr().Get()) == ("bspline", "nonperiodic")
        low, high = np.array(c.GetExtentAttr().Get())
        points = np.array(c.GetPointsAttr().Get())
        np.testing.assert_allclose(low, points.min(axis=0) - YARN.effective_fiber_radius, atol=1e-8)
        np.testing.assert_allclose(high, points.max(axis=0) + YARN.effective_fiber_radius, atol=1e-8)
        assert UsdShade.MaterialBindingAPI(c).ComputeBoundMaterial()[0].GetPath() == "/World/Looks/Fabric"
        assert min(c.GetCurveVertexCountsAttr().Get()) >= 4
        for name in ("usdfab:yarn", "usdfab:fiber"):
            assert UsdGeom.PrimvarsAPI(c).GetPrimvar(name).GetInterpolation() == "uniform"
    # Drawn curves lie on the cloth, z = 10 x y, within its thickness.
    found = world_curves(path, np.array([0.01, 0.01, 1e-3]), 5e-3)
    near = np.concatenate([f.points for f in found])
    near = near[np.linalg.norm(near - [0.01, 0.01, 1e-3], axis=1) < 5e-3]
    assert len(near) > 100
    assert np.abs(near[:, 2] - 10 * near[:, 0] * near[:, 1]).max() < 2.5 * 2 * YARN.radius


def test_modes_agree(cloth, tmp_path):
    """Instanced pieces are near the curves that are bent exactly; whole frames are no farther."""
    center = np.array([0.011, 0.009, 1e-3])
    places = {}
    for mode in MODES:
        options = replace(OPTIONS, mode=mode, overlap=0.0, tolerance=1.0)
        path = expand(cloth, tmp_path / f"{mode}.usdc", options=options).path
        parts = [f.points for f in world_curves(path, center, 2e-3)]
        points = np.concatenate(parts)
        places[mode] = points[np.linalg.norm(points - center, axis=1) < 1.5e-3]
    for mode in ("instancer", "xform"):
        distance = np.linalg.norm(places[mode][:, None] - places["baked"][None], axis=2)
        assert np.percentile(distance.min(axis=1), 99) < 4 * YARN.effective_fiber_radius
        assert len(places[mode]) > 50


def test_xforms_hold_whole_frames(tmp_path, new_mesh):
    """Sheared, mirrored and stretched cloth: the matrices are dp/dx, dp/dy and the normal."""
    stage = new_stage(tmp_path / "a.usda")
    mesh = new_mesh(stage, "/World/Cloth", [(x + 0.3 * y, 1.2 * y, 0) for x, y, _ in SQUARE], [[0, 1, 2, 3]],
                    [(1 - u, v) for u, v in UV])  # fmt: skip
    bind(stage, mesh)
    material = stage.GetPrimAtPath("/World/Looks/Fabric")
    material.GetAttribute("usdfab:metersPerUv").Set(0.02)
    stage.Save()
    path = expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=replace(OPTIONS, mode="xform", tolerance=50)).path
    out = Usd.Stage.Open(str(path))
    patches = out.GetPrimAtPath("/World/Cloth_fibers/Patches").GetChildren()
    assert len(patches) == 25 and all(p.IsInstance() for p in patches)
    expected = np.array([[-1, 0.3, 0], [0, 1.2, 0], [0, 0, np.sqrt(1.2)]])
    for patch in patches:
        matrix = np.array(UsdGeom.Xformable(patch).GetLocalTransformation())[:3, :3].T
        np.testing.assert_allclose(matrix, expected, atol=1e-5)
    assert out.GetPrimAtPath("/World/Cloth_fibers/Prototypes").IsAbstract()


def test_variants_are_those_of_the_renderer(tmp_path, new_mesh):
    stage = new_stage(tmp_path / "a.usda")
    bind(stage, new_mesh(stage, "/World/Cloth", SQUARE, [[0, 1, 2, 3]], UV))
    stage.Save()
    out = Usd.Stage.Open(str(expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=OPTIONS).path))
    instancer = UsdGeom.PointInstancer(out.GetPrimAtPath("/World/Cloth_fibers/Patches"))
    root = np.array(UsdGeom.Xformable(out.GetPrimAtPath("/World/Cloth_fibers")).GetLocalTransformation())[3, :3]
    place = np.array(instancer.GetPositionsAttr().Get()) + root
    tile = np.floor(place[:, :2] / 4e-3).astype(int)
    names = [t.name for t in instancer.GetPrototypesRel().GetTargets()]
    expected = [f"Variant{k}" for k in tile_variants(tile[:, 0], tile[:, 1], SMALL.variants)]
    assert [names[k] for k in instancer.GetProtoIndicesAttr().Get()] == expected
    assert len(set(expected)) > 1


def test_colours_of_the_mesh_and_of_a_map(tmp_path, new_mesh):
    stage = new_stage(tmp_path / "a.usda")
    mesh = new_mesh(stage, "/World/Cloth", SQUARE, [[0, 1, 2, 3]], UV)
    bind(stage, mesh)
    colors = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("usdfab:albedo", Sdf.ValueTypeNames.Color3fArray, "vertex")
    colors.Set([(0.2, 1, 1), (1, 1, 1), (1, 1, 1), (0.2, 1, 1)])
    stage.Save()
    out = Usd.Stage.Open(str(expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=OPTIONS).path))
    instancer = UsdGeom.PointInstancer(out.GetPrimAtPath("/World/Cloth_fibers/Patches"))
    root = np.array(UsdGeom.Xformable(out.GetPrimAtPath("/World/Cloth_fibers")).GetLocalTransformation())[3, :3]
    x = (np.array(instancer.GetPositionsAttr().Get()) + root)[:, 0]
    tint = UsdGeom.PrimvarsAPI(instancer).GetPrimvar("usdfab:albedo")
    assert tint.GetInterpolation() == "varying"
    np.testing.assert_allclose(np.array(tint.Get())[:, 0], 0.2 + 0.8 * x / 0.02, atol=1e-5)
    shown = np.array(UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor").Get())
    np.testing.assert_allclose(shown, np.array(tint.Get()) * YARN.albedo, atol=1e-6)

    fabric = replace(SMALL, albedo_map=str(tmp_path / "map.png"))
    (tmp_path / "map.png").write_bytes(b"")
    result = expand(tmp_path / "a.usda", tmp_path / "g.usda", fabric, OPTIONS)
    assert any("albedo map is left out" in w for w in result.warnings)
    result = expand(tmp_path / "a.usda", tmp_path / "g.usda", fabric, OPTIONS, overwrite=True,
                    textures=lambda texture, uv: np.full((len(uv), 3), 0.5))  # fmt: skip
    out = Usd.Stage.Open(str(result.path))
    instancer = UsdGeom.PointInstancer(out.GetPrimAtPath("/World/Cloth_fibers/Patches"))
    tint = np.array(UsdGeom.PrimvarsAPI(instancer).GetPrimvar("usdfab:albedo").Get())
    np.testing.assert_allclose(tint[:, 1], 0.5, atol=1e-6)
    assert str(tmp_path) not in result.path.read_text()


def test_meshes_instances_and_subsets(tmp_path, new_mesh):
    stage = new_stage(tmp_path / "a.usda")
    other = replace(SMALL, warp=replace(YARN, count=16))
    define_fabric_material(stage, "/World/Looks/Other", other)
    # one mesh of triangles and an n-gon with a fabric on each half
    points = [(0, 0, 0), (0.01, 0, 0), (0.02, 0, 0), (0.02, 0.01, 0), (0.02, 0.02, 0), (0.01, 0.02, 0), (0, 0.02, 0)]
    halves = new_mesh(stage, "/World/Halves", points, [[0, 1, 5], [0, 5, 6], [1, 2, 3, 4, 5]],
                      [(50 * x, 50 * y) for x, y, _ in points])  # fmt: skip
    bind(stage, halves)
    subset = UsdGeom.Subset.CreateGeomSubset(halves, "right", "face", [2], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(
        UsdShade.Material(stage.GetPrimAtPath("/World/Looks/Other"))
    )
    # native instances and a point instancer
    UsdGeom.Xform.Define(stage, "/Source")
    bind(stage, new_mesh(stage, "/Source/Sheet", SQUARE, [[0, 1, 2, 3]], UV))
    for k in range(5):
        copy = UsdGeom.Xform.Define(stage, f"/World/Copy{k}")
        copy.AddTranslateOp().Set(Gf.Vec3d(0, 0.1 * (k + 1), 0))
        copy.GetPrim().GetReferences().AddInternalReference("/Source")
        copy.GetPrim().SetInstanceable(True)
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Crowd")
    bind(stage, new_mesh(stage, "/World/Crowd/Prototypes/Sheet", SQUARE, [[0, 1, 2, 3]], UV))
    instancer.CreatePrototypesRel().SetTargets(["/World/Crowd/Prototypes/Sheet"])
    instancer.CreateProtoIndicesAttr([0] * 6)
    instancer.CreatePositionsAttr([Gf.Vec3f(0.1 * k, 0, 0.1) for k in range(6)])
    stage.GetPrimAtPath("/Source").SetActive(True)
    stage.GetPrimAtPath("/Source").SetSpecifier(Sdf.SpecifierClass)
    stage.Save()
    result = expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=OPTIONS)
    assert result.warnings == ()
    out = Usd.Stage.Open(str(result.path))
    # 25 tiles of 4 x 4 mm on a sheet of 2 x 2 cm: five native copies, six placed ones
    count = {
        str(p.GetPath()): len(UsdGeom.PointInstancer(p).GetProtoIndicesAttr().Get())
        for p in out.Traverse() if p.GetName() == "Patches"
    }  # fmt: skip
    assert {f"/World/Copy{k}/Sheet_fibers/Patches" for k in range(5)} < set(count)
    assert all(count[f"/World/Copy{k}/Sheet_fibers/Patches"] == 25 for k in range(5))
    assert count["/World/Sheet_fibers/Patches"] == 6 * 25
    assert {"/World/Halves_fibers/Patches", "/World/Halves_fibers_1/Patches"} < set(count)
    for k in range(5):
        middle = np.array([0.01, 0.1 * (k + 1) + 0.01, 0.0])
        assert world_curves(result.path, middle, 1e-3)
    for k in range(6):
        assert world_curves(result.path, np.array([0.1 * k + 0.01, 0.01, 0.1]), 1e-3)
    hidden = ["/World/Halves", "/World/Crowd/Prototypes/Sheet", *(f"/World/Copy{k}/Sheet" for k in range(5))]
    for path in hidden:
        assert UsdGeom.Imageable(out.GetPrimAtPath(path)).GetVisibilityAttr().Get() == "invisible"


@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_closed_mesh_without_uv_in_other_units(tmp_path, new_mesh, scheme):
    """A left-handed cube in inches, y up, with no texture coordinates: unwrapped, and its fibers stand outside."""
    stage = new_stage(tmp_path / "a.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.0254)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    mesh = new_mesh(stage, "/World/Cube", corners, [f[::-1] for f in faces])
    mesh.CreateOrientationAttr("leftHanded")
    mesh.CreateSubdivisionSchemeAttr(scheme)
    bind(stage, mesh)
    stage.Save()
    result = expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=OPTIONS)
    assert any("unwrapped" in w for w in result.warnings)
    out = Usd.Stage.Open(str(result.path))
    instancer = UsdGeom.PointInstancer(out.GetPrimAtPath("/World/Cube_fibers/Patches"))
    time = Usd.TimeCode.Default()
    local = np.array(instancer.ComputeInstanceTransformsAtTime(time, time))
    matrices = local @ np.array(instancer.ComputeLocalToWorldTransform(time))
    from_middle = matrices[:, 3, :3] - 0.5
    assert np.linalg.norm(from_middle, axis=1).max() < 0.9
    outward = np.einsum("ij,ij->i", from_middle, matrices[:, 2, :3])
    assert (outward > 0).mean() > 0.999
    # The cloth's own size: a tile of 4 mm is 4 / 25.4 of the stage's units.
    area = 6.0 if scheme == "none" else None
    cells = np.linalg.norm(np.cross(matrices[:, 0, :3], matrices[:, 1, :3]), axis=1)
    if area is not None:
        assert np.median(cells) == pytest.approx(1.0, rel=0.05)


def test_render_purpose_keeps_the_mesh_as_proxy(cloth, tmp_path):
    path = expand(cloth, tmp_path / "f.usdc", options=replace(OPTIONS, purpose="render")).path
    stage = Usd.Stage.Open(str(path))
    mesh, fibers = (UsdGeom.Imageable(stage.GetPrimAtPath(p)) for p in ("/World/Cloth", "/World/Cloth_fibers"))
    assert mesh.ComputePurpose() == "proxy" and fibers.ComputePurpose() == "render"
    assert fibers.GetProxyPrimRel().GetTargets() == ["/World/Cloth"]
    assert mesh.ComputeVisibility() == "inherited"
    assert {issue.rule for issue in check(path)} <= {"usdfab:fiberRadius", "usdfab:unusual"}  # few, thick fibers


def test_options_are_checked(cloth, tmp_path):
    for options, message in (
        (ExpandOptions(mode="none"), "there is no 'none'"),  # type: ignore[arg-type]
        (ExpandOptions(tolerance=0), "no distance"),
        (ExpandOptions(overlap=-1), "no overlap"),
        (ExpandOptions(region=(0, 0, 0, 1)), "region is empty"),
        (ExpandOptions(mode="baked", limit=10), "control points are needed"),
    ):
        with pytest.raises(UsdfabError, match=message):
            expand(cloth, tmp_path / "f.usdc", options=options)
    assert not (tmp_path / "f.usdc").exists()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scale", [1e30, 1e300, 1e-30])
def test_absurd_texture_coordinates_are_one_error_or_a_file(tmp_path, new_mesh, mode, scale):
    stage = new_stage(tmp_path / "a.usda")
    uv = [(u * min(scale, 3e38), v) for u, v in UV]
    mesh = new_mesh(stage, "/World/Cloth", [*SQUARE, (0.01, 0.03, 0)], [[0, 1, 2, 3], [3, 2, 4]], [*uv, (0.5, 2.0)])
    bind(stage, mesh)
    stage.GetPrimAtPath("/World/Looks/Fabric").GetAttribute("usdfab:metersPerUv").Set(0.02)
    stage.Save()
    for region in (None, (0.0, 0.0, 0.3, 0.3)):
        options = replace(OPTIONS, mode=mode, region=region)
        try:
            result = expand(tmp_path / "a.usda", tmp_path / "f.usdc", options=options, overwrite=True)
        except UsdfabError:
            continue
        assert result.instances < 10_000
