"""``usdfab bind``: what it prints, what it writes, and that the result renders without anything more."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pxr import Gf, Sdf, UsdGeom, UsdLux

from usdfab.usd.stage import new_stage


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """A sheet of 2 cm with uv from 0 to 1, doubled along u on its right half; a camera and light. Centimetres, y up."""
    stage = new_stage("Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/World/Cloth")
    points = [Gf.Vec3f(x, y, 0) for y in (-1, 1) for x in (-1, 0, 1)]
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 4, 3, 1, 2, 5, 4])
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    uv.Set([Gf.Vec2f(u, v) for v in (0, 1) for u in (0, 0.5, 0.75)])
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 6))
    UsdLux.DomeLight.Define(stage, "/World/Dome")
    path = tmp_path / "shot" / "cloth.usdc"
    path.parent.mkdir()
    stage.GetRootLayer().Export(str(path))
    return path


def test_reports_draws_and_renders(run, stage, tiny, tmp_path):
    out, picture = tmp_path / "bound.usda", tmp_path / "stretch.png"
    code, printed, said = run("bind", stage, tiny, "-o", out, "--rotate", 90, "--screenshot", picture, "--json")
    assert code == 0, said
    facts = json.loads(printed)
    (surface,) = facts["surfaces"]
    assert facts["schema"] == "usdfab/1" and facts["material"] == "/World/Looks/Fabric"
    assert surface["area"] == pytest.approx(4e-4) and surface["nominal_ends_per_cm"] == pytest.approx(20)
    # Turned by 90 degrees, the picks lie across u, which half of the sheet draws out to twice as much.
    assert surface["picks_per_cm"]["max"] == pytest.approx(2 * surface["picks_per_cm"]["min"])
    assert surface["ends_per_cm"]["max"] == pytest.approx(surface["ends_per_cm"]["min"])
    assert 0 < surface["above"] <= 1
    assert any("of the area" in warning for warning in facts["warnings"])
    assert picture.stat().st_size > 0
    code, printed, said = run("check", out, "--json")
    assert code == 0, printed
    image = tmp_path / "cloth.png"
    code, _, said = run("render", out, "-o", image, "--resolution", "24x16", "--spp", 1)
    assert code == 0 and image.exists(), said


def test_text_for_people(run, stage, tiny, tmp_path):
    code, printed, said = run("bind", stage, tiny, "-o", tmp_path / "b.usda", "--stretch-limit", 3)
    assert code == 0
    assert printed.startswith("/World/Cloth: 4 cm^2\n") and "ends/cm" in printed and "flat 20" in printed
    assert said.startswith("wrote ") and "/World/Looks/Fabric on /World/Cloth" in said
    code, _, said = run("bind", stage, tiny, "-o", tmp_path / "q.usda", "--quiet")
    assert code == 0 and said == ""


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--prim", "/World/None"], "no such prim"),
        (["--stretch-limit", "0.5"], "--stretch-limit"),
        (["--screenshot", "s.txt"], "cannot write '.txt' images"),
        (["--meters-per-uv", "wide"], "not a length"),
        (["--material", "/Nope"], "no such prim"),
        (["--scale", "0"], "not a factor above 0"),
    ],
)
def test_bad_input_is_one_line(run, stage, tiny, tmp_path, arguments, problem):
    out = tmp_path / "b.usda"
    code, printed, said = run("bind", stage, tiny, "-o", out, *arguments)
    assert code == 2 and printed == "" and len(said.strip().splitlines()) == 1
    assert problem in said and not out.exists()


def test_refuses_to_overwrite(run, stage, tiny, tmp_path):
    out = tmp_path / "b.usda"
    assert run("bind", stage, tiny, "-o", out)[0] == 0
    assert run("bind", stage, tiny, "-o", out)[0] == 2
    assert run("bind", stage, tiny, "-o", out, "--overwrite")[0] == 0
    assert run("bind", stage, tiny, "-o", stage, "--overwrite")[0] == 2
