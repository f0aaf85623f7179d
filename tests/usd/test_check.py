"""Each bad file breaks one rule, each clean file none; what we write passes other people's checkers too."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.usd.check import check
from usdfab.usd.fabric_io import write_fabric
from usdfab.usd.rig import write_rig

HERE = Path(__file__).parent
CLEAN = sorted((HERE / "clean").glob("*.usda"))
BAD = sorted((HERE / "bad").glob("*.usda"))
# rules of USD's own; the others are usdfab: and the file's name up to the first underscore
USD_RULES = {
    "metersPerUnit": "usdGeomValidators:StageMetadataChecker.MissingMetersPerUnitMetadata",
    "upAxis": "usdGeomValidators:StageMetadataChecker.MissingUpAxisMetadata",
    "defaultPrim": "usdValidation:StageMetadataChecker.MissingDefaultPrim",
}


@pytest.mark.parametrize("path", CLEAN, ids=lambda p: p.stem)
def test_clean(path):
    assert check(path) == []


@pytest.mark.parametrize("path", BAD, ids=lambda p: p.stem)
def test_bad(path):
    issues = check(path)
    rule = USD_RULES.get(path.stem, f"usdfab:{path.stem.split('_')[0]}")
    assert {i.rule for i in issues} == {rule}, issues
    assert all(str(path) in i.site for i in issues)
    assert {i.severity for i in issues} == {"warning" if path.stem in ("authored", "uv", "widths_varying") else "error"}


def test_issues_name_the_attribute_and_read_well():
    (issue,) = check(HERE / "bad" / "value_range.usda")
    path = HERE / "bad" / "value_range.usda"
    assert str(issue) == (
        f"error: {path}</World/Fabric.usdfab:yarn:warp:radius>: -1 is not between 1e-07 and 0.1 m (usdfab:value)"
    )


def test_materialx_shaders_are_no_false_alarm():
    stage = Usd.Stage.Open(str(HERE / "clean" / "cloth.usda"))
    shader = UsdShade.Shader.Define(stage, "/World/Looks/Fabric/OpenPbr")
    shader.CreateIdAttr("ND_open_pbr_surface_surfaceshader")
    assert check(stage) == []
    shader.CreateIdAttr("NoSuchShader")
    assert "MissingShaderIdInRegistry" in check(stage)[0].rule


def test_errors_come_first():
    stage = Usd.Stage.Open(str(HERE / "bad" / "authored.usda"))
    stage.GetPrimAtPath("/World/Fabric").CreateAttribute("usdfab:seed", Sdf.ValueTypeNames.Int).Set(-1)
    severities = [i.severity for i in check(stage)]
    assert severities[0] == "error" and set(severities[1:]) == {"warning"}


def test_unreadable_files_are_errors_of_the_user(tmp_path):
    with pytest.raises(UsdfabError, match="does not exist"):
        check(tmp_path / "none.usda")


@pytest.mark.parametrize("kind", ["fabric", "rig", "cloth"])
def test_nvidias_checker_agrees(kind, tmp_path):
    nvidia = pytest.importorskip("usd_validation_nvidia")
    path = tmp_path / f"{kind}.usda"
    if kind == "fabric":
        write_fabric(preset("linen"), path)
    elif kind == "rig":
        write_rig(path, (5e-3, 5e-3))
    else:
        path = HERE / "clean" / "cloth.usda"
    logging.disable(logging.WARNING)
    issues = nvidia.ValidationEngine().validate(str(path)).issues()
    logging.disable(logging.NOTSET)
    assert [str(i) for i in issues] == []


def test_nvidias_checker_does_look():
    nvidia = pytest.importorskip("usd_validation_nvidia")
    logging.disable(logging.WARNING)
    issues = nvidia.ValidationEngine().validate(str(HERE / "bad" / "defaultPrim.usda")).issues()
    logging.disable(logging.NOTSET)
    assert len(issues) > 0


def test_files_of_an_older_version_are_clean_without_what_came_later():
    stage = Usd.Stage.Open(str(HERE / "clean" / "fabric.usda"))
    prim = stage.GetDefaultPrim().GetChild("Fabric")
    version = prim.GetAttribute("usdfab:schemaVersion")
    assert version.Get() == 1 and not prim.GetAttribute("usdfab:variants").HasAuthoredValue()
    assert check(stage) == []
    version.Set(2)
    sites = [i.site for i in check(stage)]
    assert any("usdfab:variants" in s for s in sites) and any("warp:plyCount" in s for s in sites)
    assert {i.rule for i in check(stage)} == {"usdfab:authored"}
