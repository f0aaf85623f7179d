"""Each bad file breaks one rule, each clean file none; what we write passes other people's checkers too."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pxr import Sdf, Usd, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.usd.check import check, exit_code
from usdfab.usd.fabric_io import write_fabric
from usdfab.usd.issue import Issue
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

WARNINGS = (
    "absolute", "authored", "cover", "crimp", "fiberRadius_thick", "fiberRadius_thin", "interpenetration_crossing",
    "interpenetration_neighbours", "name_misspelt", "packing", "primvar_misspelt", "uv", "widths_varying",
)  # fmt: skip


@pytest.mark.parametrize("path", CLEAN, ids=lambda p: p.stem)
def test_clean(path):
    assert check(path) == []


@pytest.mark.parametrize("path", BAD, ids=lambda p: p.stem)
def test_bad(path):
    issues = [i for i in check(path) if i.severity != "info"]
    rule = USD_RULES.get(path.stem, f"usdfab:{path.stem.split('_')[0]}")
    assert {i.rule for i in issues} == {rule}, issues
    assert all(str(path) in i.site for i in issues)
    assert {i.severity for i in issues} == {"warning" if path.stem in WARNINGS else "error"}


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


def test_remedies_are_named():
    (issue,) = check(HERE / "bad" / "name_misspelt.usda")
    assert issue.remedy == "is usdfab:yarn:warp:radius meant?" and str(issue).endswith("meant? (usdfab:name)")
    (issue,) = check(HERE / "bad" / "primvar_misspelt.usda")[:1]
    assert "usdfab:rotation" in issue.remedy


@pytest.mark.parametrize(
    ("severities", "strict", "code"),
    [((), True, 0), (("info",), True, 0), (("warning",), False, 0), (("warning", "info"), True, 1),
     (("error", "warning"), False, 2), (("error",), True, 2)],
)  # fmt: skip
def test_exit_codes(severities, strict, code):
    assert exit_code([Issue(s, "", "usdfab:x", "") for s in severities], strict=strict) == code


def test_missing_files_are_named_once_with_their_prim(tmp_path):
    path = tmp_path / "a.usda"
    path.write_text(
        """#usda 1.0
(
    defaultPrim = "A"
    metersPerUnit = 1
    upAxis = "Z"
    subLayers = [@./nolayer.usda@]
)
def Xform "A" (
    references = @./none.usda@
    payload = @./nopayload.usda@</X>
)
{
    asset[] files = [@./a.usda@, @./gone.png@, @./there.<UDIM>.png@, @./gone.<UDIM>.png@]
    asset moving.timeSamples = {1: @./a.usda@, 2: @./later.png@}
}
"""
    )
    (tmp_path / "there.1002.png").write_bytes(b"")
    found = {(i.site.removeprefix(str(path)), i.rule) for i in check(path)}
    assert found == {
        ("", "usdfab:composition"), ("</A>", "usdfab:composition"), ("</A.files>", "usdfab:asset"),
        ("</A.moving>", "usdfab:asset"),
    }  # fmt: skip
    text = " ".join(i.message for i in check(path))
    for name in ("nolayer.usda", "none.usda", "nopayload.usda", "gone.png", "later.png", "gone.<UDIM>.png"):
        assert name in text
    assert "there." not in text


def test_instances_are_checked_once(tmp_path):
    part = tmp_path / "part.usda"
    stage = Usd.Stage.CreateInMemory()
    stage.SetDefaultPrim(stage.DefinePrim("/Part", "Xform"))
    bad = str(HERE / "bad" / "token.usda")
    stage.DefinePrim("/Part/Bad").GetReferences().AddReference(bad)
    stage.GetRootLayer().Export(str(part))
    stage = Usd.Stage.CreateInMemory()
    for number in range(5):
        prim = stage.DefinePrim(f"/Copy{number}")
        prim.GetReferences().AddReference(str(part))
        prim.SetInstanceable(True)
    assert [i.rule for i in check(stage)].count("usdfab:token") == 1


def test_cycles_end():
    assert check(HERE / "bad" / "composition_cycle.usda")[0].remedy == "take one of the arcs out"


@pytest.fixture
def quiet(capfd):
    yield
    said = capfd.readouterr()
    assert said.err == "" and said.out == ""


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("empty.usda", b"", "not a valid usda layer"),
        ("noise.usda", bytes(range(256)) * 8, "not a valid usda layer"),
        ("noise.usdc", bytes(range(256)) * 8, "corrupt"),
        ("noise.usd", bytes(range(256)) * 8, "USD cannot read"),
        ("noise.usdz", bytes(range(256)) * 8, "USD cannot read"),
        ("cut.usda", b'#usda 1.0\ndef Xform "A" {', r"cut.usda:2:\d+: Expected }"),
        ("noise.txt", b"hello", "not a USD file"),
    ],
)
def test_files_that_usd_cannot_read(tmp_path, quiet, name, content, problem):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UsdfabError, match=problem) as caught:
        check(path)
    assert len(str(caught.value).splitlines()) == 1 and str(caught.value).startswith(str(path))


def test_truncated_crates_folders_and_impossible_names(tmp_path, quiet):
    whole = write_fabric(preset("linen"), tmp_path / "a.usdc").read_bytes()
    for share in (0.05, 0.3, 0.9, 0.999):
        path = tmp_path / f"cut{share}.usdc"
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(UsdfabError, match=r"USD cannot read"):
            check(path)
    (tmp_path / "folder.usda").mkdir()
    with pytest.raises(UsdfabError, match="folder"):
        check(tmp_path / "folder.usda")
    with pytest.raises(UsdfabError):
        check("x" * 5000 + ".usda")
    with pytest.raises(UsdfabError):
        check("a\0b.usda")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_files_without_permission(tmp_path):
    path = write_fabric(preset("linen"), tmp_path / "a.usda")
    path.chmod(0)
    with pytest.raises(UsdfabError, match="not readable"):
        check(path)


TYPES = ["bool", "int", "float", "double2", "string", "token", "asset", "int[]", "string[]", "color3d[]", "matrix4d",
         "quath", "double", "timecode[]", "asset[]"]  # fmt: skip
NAMES = ["usdfab:weave:size", "usdfab:weave:matrix", "usdfab:schemaVersion", "usdfab:sampleSize", "usdfab:seed",
         "usdfab:albedoMap", "usdfab:name", "usdfab:yarn:warp:count", "usdfab:yarn:weft:albedo",
         "primvars:usdfab:scale", "primvars:st",
         "points", "faceVertexCounts", "faceVertexIndices", "extent", "widths", "curveVertexCounts",
         "orientation", "subdivisionScheme", "material:binding", "usdfab:provenance:stages", "usdfab:"]  # fmt: skip


@given(
    st.sampled_from(["Material", "Mesh", "BasisCurves", "PointInstancer", "GeomSubset", "Nonsense", ""]),
    st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(TYPES), st.booleans()), max_size=6),
    st.lists(st.sampled_from(["UsdfabFabricAPI", "UsdfabYarnAPI:warp", "UsdfabYarnAPI:weft", "UsdfabYarnAPI:",
                              "UsdfabYarnAPI", "MaterialBindingAPI", "CollectionAPI:x", "No"]), max_size=4),
)  # fmt: skip
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_nothing_but_usdfab_errors_whatever_the_types(kind, attributes, apis):
    layer = Sdf.Layer.CreateAnonymous(".usda")
    prim = Sdf.CreatePrimInLayer(layer, "/A")
    prim.specifier = Sdf.SpecifierDef
    if kind:
        prim.typeName = kind
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit(list(dict.fromkeys(apis))))
    for name, type_name, filled in attributes:
        if not Sdf.Path.IsValidNamespacedIdentifier(name) or name in prim.properties:
            continue
        value_type = Sdf.ValueTypeNames.Find(type_name)
        spec = Sdf.AttributeSpec(prim, name, value_type)
        if filled:
            spec.default = value_type.defaultValue
    check(Usd.Stage.Open(layer))
