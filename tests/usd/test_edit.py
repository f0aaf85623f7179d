"""Editing a fabric within its file: what is not edited stays, colourways are native variants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, edited, preset, recolored, weave_from_name
from usdfab.usd.check import check
from usdfab.usd.colorways import COLOR_ATTRIBUTES, COLORWAY, colorways
from usdfab.usd.edit import change_fabric, edit_fabric
from usdfab.usd.fabric_io import FABRIC_PATH, preview_color, read_fabric, write_fabric
from usdfab.usd.read_scene import read_scene
from usdfab.usd.schema_source import SCHEMA_VERSION


def dye(color: str):
    return lambda fabric: recolored(fabric, [f"warp={color}"])


def names(path: Path) -> tuple[tuple[str, ...], str]:
    stage = Usd.Stage.Open(str(path))
    return colorways(stage.GetPrimAtPath(FABRIC_PATH))


@pytest.fixture
def colored(tmp_path: Path, fabric: FabricParameters) -> Path:
    """Denim with the colourways original, navy and red (selected)."""
    path = write_fabric(fabric, tmp_path / "f.usda", meters_per_uv=0.25)
    navy = tmp_path / "navy.usda"
    change_fabric(path, dye("#102040"), navy, colorway="navy")
    change_fabric(navy, dye("#aa2222"), tmp_path / "red.usda", colorway="red")
    return tmp_path / "red.usda"


# --- what stays ------------------------------------------------------------------------------------------------------


@pytest.fixture
def studio(tmp_path: Path, fabric: FabricParameters) -> Path:
    """A fabric file in which people put things of their own; its picture and set lie in folders beside it."""
    (tmp_path / "set").mkdir()
    table = Usd.Stage.CreateNew(str(tmp_path / "set" / "table.usda"))
    table.SetDefaultPrim(UsdGeom.Cube.Define(table, "/Table").GetPrim())
    table.Save()
    (tmp_path / "map.png").write_bytes(b"")
    path = tmp_path / "f.usda"
    write_fabric(replace(fabric, albedo_map=str(tmp_path / "map.png")), path)
    stage = Usd.Stage.Open(str(path))
    material = stage.GetPrimAtPath(FABRIC_PATH)
    material.CreateAttribute("studio:note", Sdf.ValueTypeNames.String).Set("keep me")
    material.SetDocumentation("our best denim")
    material.GetVariantSets().AddVariantSet("season").AddVariant("winter")
    UsdShade.Shader.Define(stage, FABRIC_PATH + "/Other").CreateIdAttr("UsdUVTexture")
    stage.DefinePrim("/Table").GetReferences().AddReference("./set/table.usda")
    stage.GetRootLayer().customLayerData = {"studio": "ours"}
    stage.Save()
    return path


def test_everything_else_stays(studio: Path, tmp_path: Path, fabric: FabricParameters) -> None:
    (tmp_path / "out").mkdir()
    out = tmp_path / "out" / "g.usda"
    changed = edit_fabric(studio, {"warp.radius": "100um"}, out)
    assert changed == edited(read_fabric(studio), {"warp.radius": "100um"})
    stage = Usd.Stage.Open(str(out))
    material = stage.GetPrimAtPath(FABRIC_PATH)
    assert material.GetAttribute("studio:note").Get() == "keep me"
    assert material.GetDocumentation() == "our best denim"
    assert material.GetVariantSets().GetVariantSet("season").GetVariantNames() == ["winter"]
    assert stage.GetPrimAtPath(FABRIC_PATH + "/Other") and stage.GetRootLayer().customLayerData == {"studio": "ours"}
    # Relative paths fit the new folder, and nothing was flattened.
    assert stage.GetPrimAtPath("/Table").GetTypeName() == "Cube"
    assert "@../set/table.usda@" in out.read_text() and "@../map.png@" in out.read_text()
    assert read_fabric(out).albedo_map == str(tmp_path / "map.png")
    assert str(tmp_path) not in out.read_text()


def test_only_what_changes_is_authored(tmp_path: Path, fabric: FabricParameters) -> None:
    base = write_fabric(fabric, tmp_path / "f.usda")
    Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    stage = Usd.Stage.Open(str(tmp_path / "cloth.usda"))
    prim = stage.DefinePrim("/World/Looks/Cloth")
    prim.GetReferences().AddReference("./f.usda", FABRIC_PATH)
    stage.Save()
    out = tmp_path / "edited.usda"
    edit_fabric(tmp_path / "cloth.usda", {"weft.twist": ".2", "warp.albedo": ".1,.2,.3"}, out)
    layer = Sdf.Layer.FindOrOpen(str(out))
    spec = layer.GetPrimAtPath("/World/Looks/Cloth")
    assert sorted(p.name for p in spec.properties) == ["usdfab:yarn:warp:albedo", "usdfab:yarn:weft:twist"]
    assert [p.name for p in layer.GetPrimAtPath("/World/Looks/Cloth/Preview").properties] == ["inputs:diffuseColor"]
    assert read_fabric(base) == fabric
    assert read_fabric(out).weft.twist == 0.2


def test_an_edit_without_effect_is_refused(tmp_path: Path, fabric: FabricParameters) -> None:
    write_fabric(fabric, tmp_path / "strong.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    stage.GetRootLayer().subLayerPaths.append("./strong.usda")
    stage.Save()
    out = tmp_path / "out.usda"
    # Local opinions of a sublayer are stronger than a variant here.
    with pytest.raises(UsdfabError, match=r"another layer \(strong.usda\) decides"):
        change_fabric(tmp_path / "cloth.usda", dye("#102040"), out, colorway="navy")
    assert not out.exists()
    assert edit_fabric(tmp_path / "cloth.usda", {"seed": "5"}, out).seed == 5 == read_fabric(out).seed


def test_instances_and_packages(tmp_path: Path, fabric: FabricParameters) -> None:
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "instanced.usda"))
    prim = stage.DefinePrim("/Set")
    prim.GetReferences().AddReference("./f.usda")
    prim.SetInstanceable(True)
    stage.Save()
    with pytest.raises(UsdfabError, match="within an instance"):
        edit_fabric(tmp_path / "instanced.usda", {"seed": "1"}, tmp_path / "g.usda")
    package = tmp_path / "f.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(path), str(package))
    assert edit_fabric(package, {"seed": "1"}, tmp_path / "g.usda") == replace(fabric, seed=1)
    assert read_fabric(tmp_path / "g.usda") == replace(fabric, seed=1)
    with pytest.raises(UsdfabError, match="package"):
        change_fabric(package, dye("#fff"), tmp_path / "h.usda", colorway="white")


def test_a_file_can_be_edited_in_place(tmp_path: Path, fabric: FabricParameters) -> None:
    path = write_fabric(fabric, tmp_path / "f.usdc")
    with pytest.raises(UsdfabError, match="the file exists"):
        edit_fabric(path, {"seed": "2"}, path)
    edit_fabric(path, {"seed": "2"}, path, overwrite=True)
    assert read_fabric(path) == replace(fabric, seed=2)


def test_files_of_version_1_become_whole(tmp_path: Path, fabric: FabricParameters) -> None:
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath(FABRIC_PATH)
    prim.GetAttribute("usdfab:schemaVersion").Set(1)
    assert prim.RemoveProperty("usdfab:variants")
    stage.Save()
    out = tmp_path / "g.usda"
    edit_fabric(path, {"seed": "2"}, out)
    assert check(out) == []
    assert (
        Usd.Stage.Open(str(out)).GetPrimAtPath(FABRIC_PATH).GetAttribute("usdfab:schemaVersion").Get() == SCHEMA_VERSION
    )


# --- colourways ------------------------------------------------------------------------------------------------------


def test_colourways_are_native_variants(colored: Path, fabric: FabricParameters) -> None:
    assert names(colored) == (("original", "navy", "red"), "red")
    assert check(colored) == []
    stage = Usd.Stage.Open(str(colored))
    prim = stage.GetPrimAtPath(FABRIC_PATH)
    preview = stage.GetPrimAtPath(FABRIC_PATH + "/Preview").GetAttribute("inputs:diffuseColor")
    expected = {"original": fabric, "navy": dye("#102040")(fabric), "red": dye("#aa2222")(fabric)}
    for name, own in expected.items():
        # As any USD program switches them.
        assert prim.GetVariantSet(COLORWAY).SetVariantSelection(name)
        assert read_fabric(stage) == own
        assert preview.Get() == Gf.Vec3f(*preview_color(own))


def test_readers_follow_the_selection(colored: Path, tmp_path: Path, fabric: FabricParameters) -> None:
    navy = dye("#102040")(fabric)
    change_fabric(colored, None, tmp_path / "selected.usda", colorway="navy")
    assert read_fabric(tmp_path / "selected.usda") == navy and names(tmp_path / "selected.usda")[1] == "navy"
    # Cloth that wears the fabric may choose for itself.
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/Cloth")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    primvar.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    look = stage.DefinePrim("/Looks/Denim", "Material")
    look.GetReferences().AddReference("./red.usda", FABRIC_PATH)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material(look))
    UsdGeom.Camera.Define(stage, "/Camera").AddTranslateOp().Set((0.5, 0.5, 2))
    for name, own in (("navy", navy), ("original", fabric)):
        look.GetVariantSet(COLORWAY).SetVariantSelection(name)
        stage.Save()
        assert read_scene(tmp_path / "cloth.usda").fabrics[0].fabric == own


def test_colours_change_in_the_selected_colourway_only(colored: Path, tmp_path: Path, fabric: FabricParameters) -> None:
    out = tmp_path / "out.usda"
    edit_fabric(colored, {"warp.albedo": ".5,.5,.5", "warp.twist": ".3", "weave": "plain"}, out)
    stage = Usd.Stage.Open(str(out))
    selection = stage.GetPrimAtPath(FABRIC_PATH).GetVariantSet(COLORWAY)
    preview = stage.GetPrimAtPath(FABRIC_PATH + "/Preview").GetAttribute("inputs:diffuseColor")
    for name, color in (("red", (0.5, 0.5, 0.5)), ("original", fabric.warp.albedo)):
        selection.SetVariantSelection(name)
        now = read_fabric(stage)
        assert now.warp.albedo == color
        assert now.warp.twist == 0.3 and now.weave == weave_from_name("plain")  # of the cloth, not of its colours
        assert preview.Get() == Gf.Vec3f(*preview_color(now))


def test_an_existing_colourway_is_changed(colored: Path, tmp_path: Path, fabric: FabricParameters) -> None:
    out = tmp_path / "out.usda"
    # Starting from navy, although red is selected.
    changed = change_fabric(colored, lambda f: recolored(f, ["weft=#ffffff"]), out, colorway="navy")
    assert changed.warp.albedo == dye("#102040")(fabric).warp.albedo and changed.weft.albedo == (1.0, 1.0, 1.0)
    assert names(out) == (("original", "navy", "red"), "navy")
    change_fabric(out, None, tmp_path / "o.usda", colorway="original")
    assert read_fabric(tmp_path / "o.usda") == fabric


def test_the_picture_of_a_baked_look_stays_with_the_original(tmp_path: Path, fabric: FabricParameters) -> None:
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.Open(str(path))
    texture = UsdShade.Shader.Define(stage, FABRIC_PATH + "/Albedo")
    texture.CreateIdAttr("UsdUVTexture")
    source = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    diffuse = UsdShade.Shader(stage.GetPrimAtPath(FABRIC_PATH + "/Preview")).GetInput("diffuseColor")
    diffuse.ConnectToSource(source)
    stage.Save()
    out = tmp_path / "out.usda"
    change_fabric(path, dye("#102040"), out, colorway="navy")
    stage = Usd.Stage.Open(str(out))
    diffuse = UsdShade.Shader(stage.GetPrimAtPath(FABRIC_PATH + "/Preview")).GetInput("diffuseColor")
    assert not diffuse.HasConnectedSource()
    stage.GetPrimAtPath(FABRIC_PATH).GetVariantSet(COLORWAY).SetVariantSelection("original")
    assert diffuse.GetConnectedSource()[0].GetPath() == FABRIC_PATH + "/Albedo"


def test_a_referenced_fabric_gets_colourways_too(tmp_path: Path, fabric: FabricParameters) -> None:
    write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    stage.DefinePrim("/Looks/Cloth").GetReferences().AddReference("./f.usda", FABRIC_PATH)
    stage.Save()
    out = tmp_path / "out.usda"
    navy = change_fabric(tmp_path / "cloth.usda", dye("#102040"), out, colorway="navy")
    assert read_fabric(out) == navy
    change_fabric(out, None, tmp_path / "o.usda", colorway="original")
    assert read_fabric(tmp_path / "o.usda") == fabric


def test_colourways_of_a_referenced_fabric_are_overridden(
    colored: Path, tmp_path: Path, fabric: FabricParameters
) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    stage.DefinePrim("/Looks/Cloth").GetReferences().AddReference("./red.usda", FABRIC_PATH)
    stage.Save()
    out = tmp_path / "out.usda"
    changed = edit_fabric(tmp_path / "cloth.usda", {"weft.albedo": "1,1,1"}, out)
    assert read_fabric(out) == changed and changed.weft.albedo == (1.0, 1.0, 1.0)
    change_fabric(out, None, tmp_path / "o.usda", colorway="original")
    assert read_fabric(tmp_path / "o.usda") == fabric


def test_the_colours_are_only_in_the_variants(colored: Path) -> None:
    layer = Sdf.Layer.FindOrOpen(str(colored))
    spec = layer.GetPrimAtPath(FABRIC_PATH)
    assert not COLOR_ATTRIBUTES & {p.name for p in spec.properties}
    for variant in spec.variantSets[COLORWAY].variants.values():
        assert {p.name for p in variant.primSpec.properties} == COLOR_ATTRIBUTES


def test_colourways_that_are_refused(colored: Path, tmp_path: Path, fabric: FabricParameters) -> None:
    out = tmp_path / "out.usda"
    with pytest.raises(UsdfabError, match="no colourway 'green', there are original, navy, red; add --recolor"):
        change_fabric(colored, None, out, colorway="green")
    with pytest.raises(UsdfabError, match="there are none"):
        change_fabric(write_fabric(fabric, tmp_path / "p.usda"), None, out, colorway="green")
    for bad in ("a b", "a/b", "{x=y}", "-a", "é"):
        with pytest.raises(UsdfabError, match="no name for a colourway"):
            change_fabric(colored, dye("#fff"), out, colorway=bad)
    stage = Usd.Stage.Open(str(colored))
    stage.GetPrimAtPath(FABRIC_PATH).GetVariantSet(COLORWAY).ClearVariantSelection()
    stage.Save()
    with pytest.raises(UsdfabError, match="no colourway is selected"):
        edit_fabric(colored, {"warp.albedo": ".5,.5,.5"}, out)
    assert not out.exists()


def test_presets_keep_their_colourways_through_crate_files(tmp_path: Path) -> None:
    path = write_fabric(preset("taffeta"), tmp_path / "f.usdc")
    change_fabric(path, dye("#102040"), tmp_path / "g.usdc", colorway="navy")
    change_fabric(tmp_path / "g.usdc", None, tmp_path / "h.usda", colorway="original")
    assert read_fabric(tmp_path / "h.usda") == preset("taffeta")
