"""Fixtures for the USD tests: stages made in memory, and the folders of good and bad files."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

import usdfab.usd  # noqa: F401 - registers the schema before any stage exists
from usdfab.fabric import FabricParameters, preset
from usdfab.usd.fabric_io import define_fabric_material


@pytest.fixture
def fabric() -> FabricParameters:
    return preset("denim")


@pytest.fixture
def new_mesh() -> Callable[..., UsdGeom.Mesh]:
    """``new_mesh(stage, path, points, faces, uv=None)``: faces are lists of point numbers, uv is per point."""

    def make(stage: Usd.Stage, path: str, points: list, faces: list[list[int]], uv: list | None = None) -> UsdGeom.Mesh:
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
        mesh.CreateFaceVertexCountsAttr([len(f) for f in faces])
        mesh.CreateFaceVertexIndicesAttr([i for f in faces for i in f])
        mesh.CreateSubdivisionSchemeAttr("none")
        if uv is not None:
            st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
            st.Set([Gf.Vec2f(*map(float, c)) for c in uv])
        return mesh

    return make


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.fixture
def cloth_stage(new_mesh: Callable[..., UsdGeom.Mesh], fabric: FabricParameters) -> Usd.Stage:
    """A square of one unit with uv from 0 to 0.5, a fabric bound to it, and a camera; metres, z up."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    mesh = new_mesh(stage, "/World/Cloth", SQUARE, [[0, 1, 2, 3]], [(0.5 * x, 0.5 * y) for x, y, _ in SQUARE])
    UsdGeom.Scope.Define(stage, "/World/Looks")
    material = define_fabric_material(stage, "/World/Looks/Fabric", fabric)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0.5, 0.5, 2))
    return stage
