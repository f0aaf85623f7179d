"""Fibers in USD files: copies on the surface, curves that join, files that others can read."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, preset
from usdfab.fibers import generate_patch
from usdfab.fibers.tiles import tile_copies
from usdfab.usd.check import check
from usdfab.usd.expand import ExpandOptions, expand
from usdfab.usd.fabric_io import define_fabric_material, read_fabric

PATCHES = "/World/Cloth_fibers/Patches"
FEW = {"fiber_count": 5}
FEW_POINTS = ExpandOptions(vertices_per_segment=6, overlap=0.0)


@pytest.fixture
def small() -> FabricParameters:
    """Plain weave with a patch of exactly 1 mm x 0.5 mm and few fibers; the weft has two colours."""
    warp = YarnParameters(count=10, radius=2e-4, **FEW)
    weft = YarnParameters(count=20, radius=1e-4, yarn_albedo=((1, 0, 0), (0, 0, 1)), **FEW)
    return FabricParameters(size=(5e-3, 5e-3), warp=warp, weft=weft)


def grid(n: int, side: float):
    """(n + 1)^2 points of a square and its n^2 quads."""
    line = np.linspace(0, side, n + 1)
    points = [(x, y, 0.0) for y in line for x in line]
    faces = [[j * (n + 1) + i, j * (n + 1) + i + 1, (j + 1) * (n + 1) + i + 1, (j + 1) * (n + 1) + i]
             for j in range(n) for i in range(n)]  # fmt: skip
    return points, faces


@pytest.fixture
def cloth(tmp_path, new_mesh, small) -> Path:
    """A file in centimetres, y up: a turned and moved cloth of 1 cm x 1 cm whose uv is in units of 1 cm."""
    path = tmp_path / "cloth.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    world = UsdGeom.Xform.Define(stage, "/World")
    world.AddTranslateOp().Set(Gf.Vec3d(100, 20, -30))
    world.AddRotateXYZOp().Set(Gf.Vec3f(20, 40, 60))
    world.AddScaleOp().Set(Gf.Vec3f(2, 3, 4))
    stage.SetDefaultPrim(world.GetPrim())
    points, faces = grid(3, 1.0)
    points = [(x / 2, y / 3, z) for x, y, z in points]
    mesh = new_mesh(stage, "/World/Cloth", points, faces, [(2 * x, 3 * y) for x, y, _ in points])
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * len(points))
    UsdGeom.Scope.Define(stage, "/World/Looks")
    material = define_fabric_material(stage, "/World/Looks/Fabric", small)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.SetMetadata("kilogramsPerUnit", 1.0)
    stage.Save()
    return path


def world_transforms(stage, path=PATCHES):
    """(N, 4, 4) column-vector matrices from prototype space to world, and the instancer."""
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath(path))
    time = Usd.TimeCode.Default()
    local = np.array(instancer.ComputeInstanceTransformsAtTime(time, time, UsdGeom.PointInstancer.IncludeProtoXform))
    to_world = np.array(instancer.ComputeLocalToWorldTransform(time))
    return np.swapaxes(local @ to_world, 1, 2), instancer


# --- the file --------------------------------------------------------------------------------------------------------


def test_what_is_written(cloth, tmp_path, small):
    before = cloth.read_bytes()
    result = expand(cloth, tmp_path / "fibers.usda", options=FEW_POINTS)
    assert cloth.read_bytes() == before
    assert result.instances == 5 * 10 and result.prototypes == 4
    assert result.seams is not None and result.seams.largest < 1e-9
    assert result.meshes == ("/World/Cloth",) and result.warnings == ()
    stage = Usd.Stage.Open(str(result.path))
    layer = stage.GetRootLayer()
    assert list(layer.subLayerPaths) == ["./cloth.usda"]
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01 and UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert not layer.GetAttributeAtPath("/World/Cloth.points")
    mesh = UsdGeom.Imageable(stage.GetPrimAtPath("/World/Cloth"))
    assert mesh.ComputeVisibility() == "invisible"
    prototypes = stage.GetPrimAtPath(f"{PATCHES}/Prototypes")
    assert prototypes.GetSpecifier() == Sdf.SpecifierOver and not prototypes.IsDefined()
    curves = {c.GetName(): UsdGeom.BasisCurves(c) for c in prototypes.GetChild("Variant0").GetAllChildren()}
    assert set(curves) == {"Warp", "Weft"}
    assert sum(len(c.GetCurveVertexCountsAttr().Get()) for c in curves.values()) == result.curves / 4 == 40
    for name, c in curves.items():
        assert (c.GetTypeAttr().Get(), c.GetBasisAttr().Get(), c.GetWrapAttr().Get()) == (
            "cubic",
            "bspline",
            "nonperiodic",
        )
        assert c.GetNormalsAttr().Get() is None
        radius = (small.warp if name == "Warp" else small.weft).effective_fiber_radius
        np.testing.assert_allclose(c.GetWidthsAttr().Get(), [2 * radius / 0.01], rtol=1e-6)
        assert c.GetWidthsInterpolation() == "constant"
        np.testing.assert_allclose(c.GetExtentAttr().Get(), UsdGeom.Curves.ComputeExtent(
            c.GetPointsAttr().Get(), c.GetWidthsAttr().Get()), rtol=1e-5)  # fmt: skip
        assert "MaterialBindingAPI" in c.GetPrim().GetAppliedSchemas()
        bound = UsdShade.MaterialBindingAPI(c.GetPrim()).ComputeBoundMaterial()[0]
        assert bound.GetPath() == "/World/Looks/Fabric"
        api = UsdGeom.PrimvarsAPI(c)
        assert api.GetPrimvar("usdfab:yarn").GetInterpolation() == "uniform"
        assert len(api.GetPrimvar("usdfab:fiber").Get()) == len(c.GetCurveVertexCountsAttr().Get())
        assert json.loads(c.GetPrim().GetAttribute("userProperties:usdfab").Get())["system"] == name.lower()
    assert curves["Warp"].GetDisplayColorPrimvar().GetInterpolation() == "constant"
    colors = curves["Weft"].GetDisplayColorPrimvar()
    assert colors.GetInterpolation() == "uniform"
    yarn = np.asarray(UsdGeom.PrimvarsAPI(curves["Weft"]).GetPrimvar("usdfab:yarn").Get())
    np.testing.assert_allclose(np.asarray(colors.Get())[yarn % 2 == 0], np.broadcast_to((1, 0, 0), (10, 3)))
    np.testing.assert_allclose(np.asarray(colors.Get())[yarn % 2 == 1], np.broadcast_to((0, 0, 1), (10, 3)))
    root = UsdGeom.Imageable(stage.GetPrimAtPath("/World/Cloth_fibers"))
    assert Usd.ModelAPI(root).GetKind() == "subcomponent" and root.GetPurposeAttr().Get() == "default"


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_the_file_is_clean(cloth, tmp_path, suffix):
    path = expand(cloth, tmp_path / f"fibers{suffix}", options=FEW_POINTS).path
    assert {issue.rule for issue in check(path)} <= {"usdfab:fiberRadius", "usdfab:unusual"}  # few, thick fibers
    if suffix == ".usda":
        return  # NVIDIA's checker wants large arrays in .usdc, and is right
    nvidia = pytest.importorskip("usd_validation_nvidia")
    logging.disable(logging.WARNING)
    issues = nvidia.ValidationEngine().validate(str(path)).issues()
    logging.disable(logging.NOTSET)
    # about the user's own stage: its units and axis are not ours to choose
    assert [str(i) for i in issues if "fibers" in str(i)] == []


def test_extent_holds_all_fibers(cloth, tmp_path):
    stage = Usd.Stage.Open(str(expand(cloth, tmp_path / "f.usda", options=FEW_POINTS).path))
    _, instancer = world_transforms(stage)
    low, high = np.array(instancer.GetExtentAttr().Get())
    size = high - low
    assert (np.abs(size) < 2).all() and (size > 0).all()
    assert np.sort(size)[1:].min() > 0.9  # 1 cm in the stage's centimetres, turned


# --- geometry --------------------------------------------------------------------------------------------------------


def test_copies_lie_on_the_cloth_and_join(cloth, tmp_path):
    stage = Usd.Stage.Open(str(expand(cloth, tmp_path / "f.usda", options=FEW_POINTS).path))
    transforms, _ = world_transforms(stage)
    assert len(transforms) == 50
    # Where the cells should be: the mesh's own transform of uv, in the stage's centimetres.
    world = np.array(UsdGeom.Xformable(stage.GetPrimAtPath("/World/Cloth")).ComputeLocalToWorldTransform(0)).T
    columns, rows = np.meshgrid(np.arange(5), np.arange(10))
    u, v = (columns.ravel() + 0.5) * 0.2, (rows.ravel() + 0.5) * 0.1
    expected = np.column_stack([u / 2, v / 3, 0 * u, 0 * u + 1]) @ world.T
    order = np.argmin(np.linalg.norm(expected[:, None, :3] - transforms[None, :, :3, 3], axis=2), axis=1)
    assert sorted(order) == list(range(50))
    np.testing.assert_allclose(transforms[order, :3, 3], expected[:, :3], atol=1e-5)
    # The cloth is as large as its uv in every direction, so that copies are neither stretched nor turned.
    linear = world[:3, :3] / [2, 3, 4]
    np.testing.assert_allclose(transforms[:, :3, :3], np.broadcast_to(linear, (50, 3, 3)), atol=2e-3)


def spline_ends(points, counts):
    """First and last point of each nonperiodic cubic B-spline."""
    offsets = np.r_[0, np.cumsum(counts)]
    weights = np.array([1, 4, 1]) / 6
    first = np.stack([weights @ points[s : s + 3] for s in offsets[:-1]])
    last = np.stack([weights @ points[e - 3 : e] for e in offsets[1:]])
    return first, last


def test_fibers_end_where_their_continuations_begin(cloth, tmp_path, small):
    stage = Usd.Stage.Open(str(expand(cloth, tmp_path / "f.usda", options=FEW_POINTS).path))
    patch = generate_patch(small, 6, tile_copies(small))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"{PATCHES}/Prototypes/Variant0/Warp"))
    points = np.asarray(curves.GetPointsAttr().Get(), dtype=float) * 0.01
    first, last = spline_ends(points, curves.GetCurveVertexCountsAttr().Get())
    np.testing.assert_allclose(last, first[patch.warp.successor] + patch.warp.period, atol=1e-9)
    low, high = points[:, 1].min(), points[:, 1].max()
    assert -0.5 * patch.size[1] - 1e-4 < low and high < 0.5 * patch.size[1] + 4e-4


def test_flyaways_are_curves_of_their_own(cloth, tmp_path, small):
    hairy = {"flyaway_density": 5000.0, "flyaway_length": 8e-4, "ply_count": 2}
    fabric = replace(small, warp=replace(small.warp, **hairy), weft=replace(small.weft, **hairy))
    path = expand(cloth, tmp_path / "f.usda", fabric, FEW_POINTS).path
    stage = Usd.Stage.Open(str(path))
    assert {issue.rule for issue in check(path)} <= {"usdfab:fiberRadius", "usdfab:unusual"}  # few, thick fibers
    names = [c.GetName() for c in stage.GetPrimAtPath(f"{PATCHES}/Prototypes/Variant0").GetAllChildren()]
    assert names == ["Warp", "Weft", "WarpFlyaways", "WeftFlyaways"]
    patch = generate_patch(fabric, 6, tile_copies(fabric))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"{PATCHES}/Prototypes/Variant0/WarpFlyaways"))
    warp = patch.flyaways[0]
    counts = np.asarray(curves.GetCurveVertexCountsAttr().Get())
    np.testing.assert_array_equal(counts, np.diff(warp.offsets) + 2)
    # Nothing joins them: they start and end at their own ends.
    points = np.asarray(curves.GetPointsAttr().Get(), dtype=float) * 0.01
    first, last = spline_ends(points, counts)
    centre = np.array([*patch.size, 0.0]) / 2
    np.testing.assert_allclose(first, warp.points[warp.offsets[:-1]] - centre, atol=1e-9)
    np.testing.assert_allclose(last, warp.points[warp.offsets[1:] - 1] - centre, atol=1e-9)
    fiber = np.asarray(UsdGeom.PrimvarsAPI(curves).GetPrimvar("usdfab:fiber").Get())
    assert fiber.min() == patch.warp.fiber.max() + 1 == 6  # five fibers are rounded up to three in each ply
    _, instancer = world_transforms(stage)
    assert np.isfinite(np.array(instancer.GetExtentAttr().Get())).all()


# --- options and errors ----------------------------------------------------------------------------------------------


def test_region(cloth, tmp_path):
    assert expand(cloth, tmp_path / "f.usda", options=replace(FEW_POINTS, region=(0, 0, 0.6, 0.3))).instances == 3 * 3


def test_a_given_fabric_brings_its_material(cloth, tmp_path):
    denim = replace(preset("denim"), size=(4e-3, 4e-3))
    path = expand(cloth, tmp_path / "f.usda", denim, replace(FEW_POINTS, vertices_per_segment=4)).path
    stage = Usd.Stage.Open(str(path))
    curves = stage.GetPrimAtPath(f"{PATCHES}/Prototypes/Variant0/Warp")
    bound = UsdShade.MaterialBindingAPI(curves).ComputeBoundMaterial()[0]
    assert read_fabric(stage, bound.GetPath()) == denim
    assert {issue.rule for issue in check(path)} <= {"usdfab:fiberRadius", "usdfab:unusual"}  # few, thick fibers


def test_what_cannot_be_hidden_is_said(cloth, tmp_path):
    stage = Usd.Stage.Open(str(cloth))
    stage.GetPrimAtPath("/World").SetInstanceable(False)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Cloth"))
    grey = UsdShade.Material.Define(stage, "/World/Looks/Grey")
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", [0], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(grey)
    UsdLux.GeometryLight.Define(stage, "/World/Lamp")
    stage.Save()
    result = expand(cloth, tmp_path / "f.usda", options=FEW_POINTS)
    text = "\n".join(result.warnings)
    assert "only some faces are cloth" in text and "GeometryLight" in text
    assert 0 < result.instances < 50 * 16


def test_errors(cloth, tmp_path, new_mesh):
    out = tmp_path / "f.usda"
    with pytest.raises(UsdfabError, match=r"about 50 copies .* above 40"):
        expand(cloth, out, options=ExpandOptions(limit=40))
    with pytest.raises(UsdfabError, match=r"</World/Nope>: there is no mesh with a fabric"):
        expand(cloth, out, prim="/World/Nope")
    with pytest.raises(UsdfabError, match="no patch cell has its centre on the cloth"):
        expand(cloth, out, options=ExpandOptions(region=(5, 5, 6, 6)))
    with pytest.raises(UsdfabError, match="the file to write is the file to read"):
        expand(cloth, cloth, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cloth.usda"]
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    new_mesh(stage, "/M", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]])
    stage.Save()
    with pytest.raises(UsdfabError, match="there is no mesh with a fabric; bind one"):
        expand(tmp_path / "bare.usda", out)
