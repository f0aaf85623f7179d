"""Fabric files: loss-free, clean, atomic, and clear about what is wrong with them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import (
    NAMED_WEAVES,
    PRESETS,
    YARN_PARAMETERS,
    FabricParameters,
    Provenance,
    Weave,
    YarnParameters,
    preset,
)
from usdfab.usd.atomic import atomic_path
from usdfab.usd.check import check
from usdfab.usd.edit import edit_fabric
from usdfab.usd.fabric_io import (
    FABRIC_PATH,
    define_fabric_material,
    preview_color,
    read_fabric,
    read_meters_per_uv,
    write_fabric,
)

# --- round trip ------------------------------------------------------------------------------------------------------

channel = st.floats(0, 1)
color = st.tuples(channel, channel, channel)
text = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]) | st.sampled_from("\n\t\"'\\"), max_size=20
)


def values_of(parameter):
    if parameter.kind == "color":
        return color
    if parameter.kind == "colors":
        return st.lists(color, max_size=4).map(tuple)
    if parameter.kind == "int":
        return st.integers(*map(int, parameter.hard))
    return st.floats(*parameter.hard)


yarns = st.fixed_dictionaries({p.name: values_of(p) for p in YARN_PARAMETERS}).map(lambda v: YarnParameters(**v))
weaves = st.builds(lambda w, name: Weave(w.matrix, name), st.sampled_from(list(NAMED_WEAVES.values())), text)
provenances = st.builds(Provenance, text, text, text, st.lists(text).map(tuple), st.lists(text).map(tuple))
side = st.floats(1e-5, 10.0)
fabrics = st.builds(
    FabricParameters, weaves, st.tuples(side, side), yarns, yarns, st.integers(0, 2**31 - 1), text, provenances,
    st.integers(1, 16),
)  # fmt: skip


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
@given(fabric=fabrics, meters=st.floats(0, 1e3))
def test_round_trip_is_loss_free(tmp_path_factory, suffix, fabric, meters):
    path = tmp_path_factory.mktemp("round") / f"f{suffix}"
    write_fabric(fabric, path, meters_per_uv=meters)
    assert read_fabric(path) == fabric
    assert read_meters_per_uv(path) == meters


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_are_clean_and_author_everything(name, tmp_path):
    path = write_fabric(preset(name), tmp_path / "f.usda")
    assert {i.rule for i in check(path)} <= {"usdfab:cover", "usdfab:unusual"}
    assert read_fabric(path) == preset(name)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath(FABRIC_PATH)
    names = [n for n in prim.GetPropertyNames() if n.startswith("usdfab:")]
    assert len(names) == 16 + 2 * len(YARN_PARAMETERS)
    # without an albedo map there is none to author: an empty path is a broken reference to USD's own validators
    assert [n for n in names if not prim.GetAttribute(n).HasAuthoredValue()] == [
        "usdfab:albedoMap",
        "usdfab:neural:weights",
    ]
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetRootLayer().customLayerData["usdfab"]["generator"].startswith("usdfab ")


def test_files_of_version_1_get_the_defaults_of_what_is_new(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath(FABRIC_PATH)
    prim.GetAttribute("usdfab:schemaVersion").Set(1)
    new = ("plyCount", "plyTwist", "flyawayDensity", "flyawayLoopFraction", "flyawayLength", "flyawaySpread")
    for name in ("usdfab:variants", *(f"usdfab:yarn:{s}:{n}" for s in ("warp", "weft") for n in new)):
        assert prim.RemoveProperty(name)
    assert read_fabric(stage) == fabric
    assert fabric.variants == 4 and fabric.warp.ply_count == 1 and fabric.warp.flyaway_density == 0


def test_the_material_can_be_referenced(tmp_path, fabric):
    write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    prim = stage.DefinePrim("/World/Looks/Cloth")
    prim.GetReferences().AddReference("f.usda", FABRIC_PATH)
    stage.Save()
    assert read_fabric(stage) == fabric
    assert UsdShade.Material(prim).ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"


def test_several_fabrics_are_named(fabric):
    stage = Usd.Stage.CreateInMemory()
    define_fabric_material(stage, "/A", fabric)
    define_fabric_material(stage, "/B", preset("silk-satin"))
    with pytest.raises(UsdfabError, match=r"several fabrics \(/A, /B\)"):
        read_fabric(stage)
    assert read_fabric(stage, "/B") == preset("silk-satin")


# --- preview ---------------------------------------------------------------------------------------------------------


def test_preview_color_counts_which_yarn_is_on_top():
    warp, weft = YarnParameters(albedo=(1, 0, 0)), YarnParameters(albedo=(0, 0, 1))
    twill = FabricParameters(NAMED_WEAVES["denim"], (1e-3, 1e-3), warp, weft)
    np.testing.assert_allclose(preview_color(twill), (0.75, 0, 0.25))
    stripes = replace(twill, warp=replace(warp, yarn_albedo=((1, 0, 0), (0, 1, 0))))
    np.testing.assert_allclose(preview_color(stripes), (0.375, 0.375, 0.25))


def test_preview_color_of_colours_that_repeat_with_the_weave():
    # Plain weave, ends alternately red and green, picks alternately blue and black: on top are (0,0) and (1,1) of the
    # weft, (0,1) and (1,0) of the warp.
    warp = YarnParameters(yarn_albedo=((1, 0, 0), (0, 1, 0)))
    weft = YarnParameters(yarn_albedo=((0, 0, 1), (0, 0, 0)))
    np.testing.assert_allclose(preview_color(FabricParameters(warp=warp, weft=weft)), (0.25, 0.25, 0.25))


# --- bad input -------------------------------------------------------------------------------------------------------


def test_files_that_are_no_fabric(tmp_path):
    with pytest.raises(UsdfabError, match=r"missing.usda: the file does not exist"):
        read_fabric(tmp_path / "missing.usda")
    for name in ("photo.png", "broken.usda", "broken.usdc"):
        (tmp_path / name).write_bytes(b"\x89PNG nonsense")
        with pytest.raises(UsdfabError, match=r"not a USD file|USD cannot read"):
            read_fabric(tmp_path / name)
    with pytest.raises(UsdfabError, match="folder"):
        read_fabric(tmp_path)
    Usd.Stage.CreateNew(str(tmp_path / "empty.usda")).Save()
    with pytest.raises(UsdfabError, match=r"no fabric in this stage; make one with"):
        read_fabric(tmp_path / "empty.usda")


def test_prims_that_are_no_fabric(cloth_stage):
    for path, problem in (("/World/Nope", "no such prim"), ("/World/Cloth", "not a usdfab fabric"), ("//", "prim")):
        with pytest.raises(UsdfabError, match=problem):
            read_fabric(cloth_stage, path)


BAD_VALUES = [
    ("usdfab:yarn:warp:radius", math.nan, "nan is not between"),
    ("usdfab:yarn:weft:radius", -1.0, "-1 is not between 1e-07 and 0.1 m"),
    ("usdfab:yarn:weft:fiberCount", 0, "not between 1 and 20000"),
    ("usdfab:yarn:warp:albedo", Gf.Vec3d(0.5, 1.5, 0), "1.5 is not between 0 and 1"),
    ("usdfab:yarn:warp:yarnAlbedo", [Gf.Vec3d(0.5, math.inf, 0)], "inf is not between"),
    ("usdfab:sampleSize", Gf.Vec2d(0, 1), "a side of 0.0 m"),
    ("usdfab:seed", -1, "-1 is not between"),
    ("usdfab:variants", 17, "17 is not a whole number from 1 to 16"),
    ("usdfab:yarn:weft:plyCount", 5, "5 is not between 1 and 4"),
    ("usdfab:weave:matrix", [1, 0, 0], "3 values, the size 4 x 4 asks for 16"),
    ("usdfab:weave:matrix", [1] * 16, "never interlaces"),
    ("usdfab:weave:matrix", [2] * 16, "only 0"),
    ("usdfab:schemaVersion", 99, "newer than this usdfab"),
]


@pytest.mark.parametrize(("name", "value", "problem"), BAD_VALUES)
def test_bad_values_are_located(tmp_path, fabric, name, value, problem):
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath(FABRIC_PATH).GetAttribute(name).Set(value)
    with pytest.raises(UsdfabError) as caught:
        read_fabric(stage)
    assert caught.value.place == f"{path}<{FABRIC_PATH}.{name}>"
    assert problem in caught.value.problem


def test_missing_and_mistyped_attributes(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda")
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath(FABRIC_PATH).GetAttribute("usdfab:yarn:warp:crimp").Block()
    with pytest.raises(UsdfabError, match=r"warp:crimp>: the attribute is missing"):
        read_fabric(stage)
    mistyped = path.read_text().replace("double usdfab:yarn:warp:radius =", "string usdfab:yarn:warp:radius = 'x' #")
    (tmp_path / "typed.usda").write_text(mistyped)
    with pytest.raises(UsdfabError, match=r"warp:radius>: expected a value of type double"):
        read_fabric(tmp_path / "typed.usda")
    with pytest.raises(UsdfabError, match="not a length"):
        define_fabric_material(stage, "/X", fabric, meters_per_uv=-1)
    UsdGeom.Cube.Define(stage, "/Cube")
    with pytest.raises(UsdfabError, match="a Cube is in the fabric's place"):
        define_fabric_material(stage, "/Cube", fabric)


def test_texts_that_usd_cannot_store(tmp_path, fabric):
    for bad in ("a\0b", "a\rb", "\ud800"):
        with pytest.raises(UsdfabError, match="name: the text holds"):
            write_fabric(replace(fabric, name=bad), tmp_path / "f.usda")
        with pytest.raises(UsdfabError, match="provenance:notes: the text holds"):
            write_fabric(replace(fabric, provenance=Provenance(notes=("fine", bad))), tmp_path / "f.usda")
    assert list(tmp_path.iterdir()) == []


# --- writing ---------------------------------------------------------------------------------------------------------


def test_outputs_that_are_refused(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda")
    with pytest.raises(UsdfabError, match="the file exists"):
        write_fabric(fabric, path)
    with pytest.raises(UsdfabError, match="folder does not exist"):
        write_fabric(fabric, tmp_path / "no" / "f.usda")
    with pytest.raises(UsdfabError, match=r"cannot write '.png' files; use .usda"):
        write_fabric(fabric, tmp_path / "f.png")
    (tmp_path / "d.usda").mkdir()
    with pytest.raises(UsdfabError, match="a folder is in the file's place"):
        write_fabric(fabric, tmp_path / "d.usda", overwrite=True)


def test_unwritable_folder(tmp_path, fabric, monkeypatch):
    monkeypatch.setattr("usdfab.files.os.access", lambda *_: False)
    with pytest.raises(UsdfabError, match="the folder is not writable"):
        write_fabric(fabric, tmp_path / "f.usda")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "f.usda"
    path.write_text("old")
    with pytest.raises(UsdfabError, match="disk full"), atomic_path(path, overwrite=True) as temporary:
        temporary.write_text("half")
        raise OSError("disk full")
    assert [p.name for p in tmp_path.iterdir()] == ["f.usda"]
    assert path.read_text() == "old"


def test_overwriting_is_seen_by_layers_that_are_open(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda")
    layer = Sdf.Layer.FindOrOpen(str(path))
    write_fabric(preset("silk-satin"), path, overwrite=True)
    assert read_fabric(path) == preset("silk-satin")
    assert layer.identifier


# --- editing ---------------------------------------------------------------------------------------------------------


def test_edit_keeps_everything_else(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda", meters_per_uv=0.25)
    out = tmp_path / "g.usdc"
    changed = edit_fabric(path, {"warp.albedo": ".1,.2,.5", "weave": "plain"}, out)
    assert read_fabric(out) == changed
    assert changed.warp.albedo == (0.1, 0.2, 0.5)
    assert changed.weft == fabric.weft
    assert read_meters_per_uv(out) == 0.25
    with pytest.raises(UsdfabError, match="unknown parameter"):
        edit_fabric(path, {"warp.colour": "1"}, tmp_path / "h.usda")
    assert not (tmp_path / "h.usda").exists()
