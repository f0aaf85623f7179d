"""Binding a fabric to stages of every make: overs only, standard bindings, and what cannot be bound said clearly."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.usd.bind import bind
from usdfab.usd.check import check
from usdfab.usd.fabric_io import define_fabric_material, write_fabric
from usdfab.usd.orientation import ROTATION, SCALE
from usdfab.usd.read_scene import read_scene
from usdfab.usd.stage import new_stage

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
UV = [(x, y) for x, y, _ in SQUARE]
QUAD = [[0, 1, 2, 3]]


@pytest.fixture
def fabric_file(tmp_path) -> Path:
    folder = tmp_path / "fabrics"
    folder.mkdir()
    return write_fabric(preset("denim"), folder / "denim.usda")


@pytest.fixture
def make(tmp_path, new_mesh):
    """``make(build, name="cloth.usda")``: a file with /World, which ``build(stage)`` furnishes; also its bytes kept."""

    def make(build, name="cloth.usda", up="Z", meters=1.0, default=True):
        stage = new_stage(up)
        UsdGeom.SetStageMetersPerUnit(stage, meters)
        world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
        if default:
            stage.SetDefaultPrim(world)
        build(stage)
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True, parents=True)
        stage.GetRootLayer().Export(str(path))
        return path

    return make


def finish(mesh):
    """What UsdValidation and asset checkers want of a mesh."""
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    return mesh


@pytest.fixture
def one(make, new_mesh):
    return make(lambda stage: finish(new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)))


def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def bound_material(path, prim, purpose=""):
    stage = Usd.Stage.Open(str(path))
    material, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(prim)).ComputeBoundMaterial(purpose)
    return str(material.GetPath()) if material else None


def fabrics_of(path):
    """Mesh path to the names of the fabrics on it."""
    scene = read_scene(path)
    return {
        m.path: {scene.fabrics[scene.materials[k].fabric].fabric.name for k in m.face_material
                 if scene.materials[k].fabric >= 0}
        for m in scene.meshes
    }  # fmt: skip


def test_overs_only_and_clean(one, fabric_file, tmp_path):
    before = digest(one)
    out = tmp_path / "bound.usda"
    bound = bind(one, fabric_file, out)
    assert bound.material == "/World/Looks/Fabric" and bound.targets == bound.meshes == ("/World/Cloth",)
    assert bound.warnings == () and digest(one) == before
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert list(layer.subLayerPaths) == ["./cloth.usda"]
    assert layer.GetPrimAtPath("/World/Cloth").specifier == Sdf.SpecifierOver
    assert sorted(layer.GetPrimAtPath("/World/Cloth").properties.keys()) == ["material:binding"]
    (reference,) = layer.GetPrimAtPath("/World/Looks/Fabric").referenceList.GetAddedOrExplicitItems()
    assert reference.assetPath == "./fabrics/denim.usda" and str(reference.primPath) == "/Looks/Fabric"
    assert "MaterialBindingAPI" in Usd.Stage.Open(str(out)).GetPrimAtPath("/World/Cloth").GetAppliedSchemas()
    assert check(out) == []
    assert fabrics_of(out) == {"/World/Cloth": {"Denim"}}


def test_no_path_in_the_file_is_absolute(one, fabric_file, tmp_path):
    out = tmp_path / "deep" / "er"
    out.mkdir(parents=True)
    bind(one, fabric_file, out / "bound.usda", rotate=10, scale=2)
    text = (out / "bound.usda").read_text()
    assert str(tmp_path) not in text and "@../../cloth.usda@" in text and "@../../fabrics/denim.usda@" in text
    assert fabrics_of(out / "bound.usda") == {"/World/Cloth": {"Denim"}}


def test_stage_metadata_is_that_of_the_stage(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        stage.SetStartTimeCode(3)
        stage.SetEndTimeCode(9)
        stage.SetTimeCodesPerSecond(48)
        stage.SetFramesPerSecond(48)
        points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Cloth")).GetPointsAttr()
        points.Set([Gf.Vec3f(*map(float, p)) for p in SQUARE], 3)
        points.Set([Gf.Vec3f(*map(float, p)) + Gf.Vec3f(0, 0, 6) for p in SQUARE], 9)

    source = make(build, "cloth.usdc", up="Y", meters=0.01)
    bind(source, fabric_file, tmp_path / "bound.usda")
    stage, base = Usd.Stage.Open(str(tmp_path / "bound.usda")), Usd.Stage.Open(str(source))
    for ask in ("GetStartTimeCode", "GetEndTimeCode", "GetTimeCodesPerSecond", "GetFramesPerSecond"):
        assert getattr(stage, ask)() == getattr(base, ask)()
    assert stage.GetDefaultPrim().GetPath() == base.GetDefaultPrim().GetPath()
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01 and UsdGeom.GetStageUpAxis(stage) == "Y"
    # Samples keep their time codes.
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Cloth")).GetPointsAttr()
    assert points.GetTimeSamples() == [3, 9] and points.Get(6)[0][2] == pytest.approx(3)


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd"])
def test_formats_z_up_centimetres(make, new_mesh, fabric_file, tmp_path, suffix):
    points = [(100 * x, 100 * y, 100 * z) for x, y, z in SQUARE]
    source = make(lambda s: new_mesh(s, "/World/Cloth", points, QUAD, UV), f"in/cloth{suffix}", meters=0.01)
    out = tmp_path / f"bound{suffix}"
    bind(source, fabric_file, out)
    scene = read_scene(out)
    # A square of one metre with uv from 0 to 1.
    assert scene.fabrics[0].meters_per_uv == pytest.approx(1.0) and scene.up_axis == "Z"


def test_left_handed_meshes_without_uv(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        new_mesh(stage, "/World/Cloth", SQUARE, QUAD).CreateOrientationAttr("leftHanded")

    bind(make(build), fabric_file, tmp_path / "bound.usda")
    scene = read_scene(tmp_path / "bound.usda")
    assert any("unwrapped" in w for w in scene.warnings)
    corners = scene.meshes[0].points[scene.meshes[0].triangles]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] < 0).all()


def test_orientation_and_scale_go_on_the_prim(one, fabric_file, tmp_path):
    out = tmp_path / "bound.usda"
    bind(one, fabric_file, out, rotate=90, scale=2, meters_per_uv=0.5)
    stage = Usd.Stage.Open(str(out))
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Cloth"))
    assert api.GetPrimvar(ROTATION).Get() == 90 and api.GetPrimvar(SCALE).Get() == 2
    scene = read_scene(out)
    assert scene.fabrics[0].meters_per_uv == 0.25
    assert check(out) == []


# --- what is bound ---


def subset_stage(family):
    def build(new_mesh):
        def furnish(stage):
            points = [(x, y, 0) for y in (0, 1) for x in (0, 1, 2)]
            uv = [(x, y) for x, y, _ in points]
            mesh = new_mesh(stage, "/World/Cloth", points, [[0, 1, 4, 3], [1, 2, 5, 4]], uv)
            subset = UsdGeom.Subset.Define(stage, mesh.GetPath().AppendChild("Left"))
            subset.CreateElementTypeAttr("face")
            subset.CreateIndicesAttr([0])
            if family:
                subset.CreateFamilyNameAttr(family)

        return furnish

    return build


@pytest.mark.parametrize("family", ["", "materialBind", "parts"])
def test_subsets(make, new_mesh, fabric_file, tmp_path, family):
    out = tmp_path / "bound.usda"
    bound = bind(
        make(subset_stage(family)(new_mesh)), fabric_file, out, prims=["/World/Cloth/Left"], rotate=90
    )  # fmt: skip
    (name,) = bound.meshes
    assert name == ("/World/Cloth/Left_fabric" if family == "parts" else "/World/Cloth/Left")
    stage = Usd.Stage.Open(str(out))
    subset = UsdGeom.Subset(stage.GetPrimAtPath(name))
    assert subset.GetFamilyNameAttr().Get() == "materialBind" and list(subset.GetIndicesAttr().Get()) == [0]
    if family == "parts":
        assert UsdGeom.Subset(stage.GetPrimAtPath("/World/Cloth/Left")).GetFamilyNameAttr().Get() == "parts"
        assert "'parts'" in bound.warnings[0]
    scene = read_scene(out)
    cloth = np.array([m.fabric for m in scene.materials])[scene.meshes[0].face_material] >= 0
    x = scene.meshes[0].points[scene.meshes[0].triangles][..., 0].mean(axis=1)
    np.testing.assert_array_equal(cloth, x < 1)
    assert [i for i in check(out) if "ubset" in i.rule or "inding" in i.rule] == []


def two_meshes(new_mesh):
    def build(stage):
        for name in ("A/Deep/Er/Cloth", "B/Cloth"):
            UsdGeom.Xform.Define(stage, "/World/A")
            new_mesh(stage, f"/World/{name}", SQUARE, QUAD, UV)

    return build


def test_several_candidates_are_listed_or_all_bound(make, new_mesh, fabric_file, tmp_path):
    source, out = make(two_meshes(new_mesh)), tmp_path / "bound.usda"
    with pytest.raises(UsdfabError, match=r"2 meshes could be cloth.*--all.*/World/A/Deep/Er/Cloth, /World/B/Cloth"):
        bind(source, fabric_file, out)
    assert not out.exists() and list(tmp_path.glob(".bound*")) == []
    bind(source, fabric_file, out, every=True)
    assert fabrics_of(out) == {"/World/A/Deep/Er/Cloth": {"Denim"}, "/World/B/Cloth": {"Denim"}}


def test_an_ancestor_binds_what_is_below(make, new_mesh, fabric_file, tmp_path):
    bound = bind(make(two_meshes(new_mesh)), fabric_file, tmp_path / "b.usda", prims=["/World/A"])
    assert bound.meshes == ("/World/A/Deep/Er/Cloth",)
    assert bound_material(tmp_path / "b.usda", "/World/A/Deep/Er/Cloth") == "/World/Looks/Fabric"
    assert bound_material(tmp_path / "b.usda", "/World/B/Cloth") is None


@pytest.mark.parametrize("owner", ["/World", "/World/Sets"])
@pytest.mark.parametrize("form", ["{}.collection:cloth", "{}:cloth"])
def test_collections(make, new_mesh, fabric_file, tmp_path, owner, form):
    def build(stage):
        two_meshes(new_mesh)(stage)
        UsdGeom.Scope.Define(stage, "/World/Sets")
        collection = Usd.CollectionAPI.Apply(stage.GetPrimAtPath(owner), "cloth")
        collection.CreateIncludesRel().AddTarget("/World/A")

    out = tmp_path / "bound.usda"
    bound = bind(make(build), fabric_file, out, collections=[form.format(owner)], rotate=45)
    assert bound.targets == (f"{owner}.collection:cloth",) and bound.warnings == ()
    assert bound_material(out, "/World/A/Deep/Er/Cloth") == "/World/Looks/Fabric"
    assert bound_material(out, "/World/B/Cloth") is None
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/World").GetRelationship("material:binding:collection:Fabric")
    assert UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/A/Deep/Er/Cloth")).GetPrimvar(ROTATION).Get() == 45
    assert [i for i in check(out) if "inding" in i.rule] == []


def test_instances_by_their_root_only(make, new_mesh, fabric_file, tmp_path):
    make(lambda s: new_mesh(s, "/World/Cloth", SQUARE, QUAD, UV), "part.usda")

    def build(stage):
        prim = UsdGeom.Xform.Define(stage, "/World/Copy").GetPrim()
        prim.GetReferences().AddReference("./part.usda")
        prim.SetInstanceable(True)

    source = make(build, "shot.usda")
    with pytest.raises(UsdfabError, match=r"inside an instance.*bind the instance root /World/Copy"):
        bind(source, fabric_file, tmp_path / "b.usda", prims=["/World/Copy/Cloth"])
    bound = bind(source, fabric_file, tmp_path / "b.usda", rotate=90)
    assert bound.targets == ("/World/Copy",) and bound.warnings == ()
    assert fabrics_of(tmp_path / "b.usda") == {"/World/Copy/Cloth": {"Denim"}}


@pytest.mark.parametrize("prim", ["/World/Many/Prototypes/Cloth", "/World/Many/Prototypes", "/World/Many"])
def test_prototypes_of_point_instancers(make, new_mesh, fabric_file, tmp_path, prim):
    def build(stage):
        instancer = UsdGeom.PointInstancer.Define(stage, "/World/Many")
        new_mesh(stage, "/World/Many/Prototypes/Cloth", SQUARE, QUAD, UV)
        stage.GetRootLayer().GetPrimAtPath("/World/Many/Prototypes").specifier = Sdf.SpecifierOver
        instancer.CreatePrototypesRel().SetTargets(["/World/Many/Prototypes/Cloth"])
        instancer.CreateProtoIndicesAttr([0] * 6)
        instancer.CreatePositionsAttr([Gf.Vec3f(2 * i, 0, 0) for i in range(6)])

    bound = bind(make(build), fabric_file, tmp_path / "b.usda", prims=[prim], rotate=90)
    assert bound.meshes == ("/World/Many/Prototypes/Cloth",) and bound.warnings == ()
    (mesh,) = read_scene(tmp_path / "b.usda").meshes
    assert len(mesh.placements) == 6
    assert fabrics_of(tmp_path / "b.usda") == {"/World/Many/Prototypes/Cloth": {"Denim"}}


# --- what wins ---


def material(stage, path):
    return UsdShade.Material.Define(stage, path)


def test_stronger_bindings_are_named(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        new_mesh(stage, "/World/A/Cloth", SQUARE, QUAD, UV)
        other = material(stage, "/World/Looks/Other")
        UsdShade.MaterialBindingAPI.Apply(stage.DefinePrim("/World/A")).Bind(
            other, UsdShade.Tokens.strongerThanDescendants
        )

    source, out = make(build), tmp_path / "bound.usda"
    bound = bind(source, fabric_file, out, prims=["/World/A/Cloth"])
    (warning,) = bound.warnings
    assert "/World/A.material:binding wins and shows /World/Looks/Other" in warning
    assert bound_material(out, "/World/A/Cloth") == "/World/Looks/Other"


def test_weaker_bindings_below_lose_on_demand(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        mesh = new_mesh(stage, "/World/A/Cloth", SQUARE, QUAD, UV)
        UsdGeom.Xform.Define(stage, "/World/A")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material(stage, "/World/Looks/Other"))

    source, out = make(build), tmp_path / "bound.usda"
    (warning,) = bind(source, fabric_file, out, prims=["/World/A"]).warnings
    assert "/World/A/Cloth.material:binding wins" in warning and "--stronger" in warning
    bound = bind(source, fabric_file, out, prims=["/World/A"], stronger=True, overwrite=True)
    assert bound.warnings == () and bound_material(out, "/World/A/Cloth") == bound.material


def test_collection_bindings_and_purposes_that_win_are_named(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        mesh = new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        collection = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World/Cloth"), "all")
        collection.CreateIncludesRel().AddTarget("/World/Cloth")
        other = material(stage, "/World/Looks/Other")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(collection, other, "old")

    (warning,) = bind(make(build), fabric_file, tmp_path / "b.usda").warnings
    assert "/World/Cloth.material:binding:collection:old wins" in warning

    def purpose(stage):
        mesh = new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(
            material(stage, "/World/Looks/Other"), materialPurpose="full"
        )

    (warning,) = bind(make(purpose, "p.usda"), fabric_file, tmp_path / "p_bound.usda").warnings
    assert "material:binding:full wins" in warning and "purpose 'full'" in warning


def test_faces_with_materials_of_their_own_are_named(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        mesh = new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset("Trim", [0])
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material(stage, "/World/Looks/Other"))

    (warning,) = bind(make(build), fabric_file, tmp_path / "b.usda").warnings
    assert "/World/Cloth/Trim: faces with materials of their own keep them" in warning


# --- where the material goes ---


def test_a_taken_name_is_left_alone(make, new_mesh, fabric_file, tmp_path):
    def build(stage):
        new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        UsdGeom.Scope.Define(stage, "/World/Materials")
        material(stage, "/World/Materials/Fabric")

    assert bind(make(build), fabric_file, tmp_path / "b.usda").material == "/World/Materials/Fabric_1"


def test_stages_without_default_prim(make, new_mesh, fabric_file, tmp_path):
    source = make(lambda s: new_mesh(s, "/World/Cloth", SQUARE, QUAD, UV), default=False)
    bound = bind(source, fabric_file, tmp_path / "b.usda")
    assert bound.material == "/World/Looks/Fabric" and bound.warnings == ()
    assert all(issue.severity != "error" for issue in check(tmp_path / "b.usda"))

    def several(stage):
        new_mesh(stage, "/Other/Cloth", SQUARE, QUAD, UV)

    bound = bind(make(several, "s.usda", default=False), fabric_file, tmp_path / "s_bound.usda")
    assert bound.material == "/Looks/Fabric" and "no default prim" in bound.warnings[0]
    assert fabrics_of(tmp_path / "s_bound.usda") == {"/Other/Cloth": {"Denim"}}


def test_stages_without_units(make, new_mesh, fabric_file, tmp_path):
    path = tmp_path / "bare.usda"
    stage = Usd.Stage.CreateInMemory()
    new_mesh(stage, "/Cloth", SQUARE, QUAD, UV)
    stage.GetRootLayer().Export(str(path))
    bound = bind(path, fabric_file, tmp_path / "b.usda")
    # The mesh is the default prim: its material travels inside it.
    assert bound.material == "/Cloth/Looks/Fabric"
    assert "metersPerUnit is not authored, 0.01" in bound.warnings[0]
    assert read_scene(tmp_path / "b.usda").fabrics[0].meters_per_uv == pytest.approx(0.01)


def test_binding_again_over_a_bound_stage(one, fabric_file, tmp_path):
    first, second = tmp_path / "first.usda", tmp_path / "second.usda"
    bind(one, fabric_file, first)
    linen = write_fabric(preset("linen"), tmp_path / "linen.usda")
    bound = bind(first, linen, second, prims=["/World/Cloth"])
    assert bound.material == "/World/Looks/Fabric_1" and bound.warnings == ()
    assert fabrics_of(second) == {"/World/Cloth": {"LinenPlain"}}
    assert fabrics_of(first) == {"/World/Cloth": {"Denim"}}


def test_one_of_several_fabrics(one, tmp_path):
    stage = new_stage()
    UsdGeom.Scope.Define(stage, "/Looks")
    for name in ("denim", "linen"):
        define_fabric_material(stage, f"/Looks/{name.capitalize()}", preset(name))
    path = tmp_path / "library.usdc"
    stage.GetRootLayer().Export(str(path))
    with pytest.raises(UsdfabError, match=r"several fabrics \(/Looks/Denim, /Looks/Linen\)"):
        bind(one, path, tmp_path / "b.usda")
    assert bind(one, path, tmp_path / "b.usda", material="/Looks/Linen").material == "/World/Looks/Linen"
    assert fabrics_of(tmp_path / "b.usda") == {"/World/Cloth": {"LinenPlain"}}


def test_a_colourway_is_selected(one, fabric_file, tmp_path):
    stage = Usd.Stage.Open(str(fabric_file))
    prim = stage.GetPrimAtPath("/Looks/Fabric")
    looks = prim.GetVariantSets().AddVariantSet("look")
    for name, seed in (("navy", 5), ("red", 6)):
        looks.AddVariant(name)
        looks.SetVariantSelection(name)
        prim.GetAttribute("usdfab:seed").Clear()
        with looks.GetVariantEditContext():
            prim.GetAttribute("usdfab:seed").Set(seed)
    looks.ClearVariantSelection()
    stage.GetRootLayer().Save()
    bind(one, fabric_file, tmp_path / "b.usda", variants={"look": "red"})
    assert read_scene(tmp_path / "b.usda").fabrics[0].fabric.seed == 6
    for variants, problem in (({"size": "big"}, "no variant set 'size'; it has look"), ({"look": "x"}, "navy, red")):
        with pytest.raises(UsdfabError, match=problem):
            bind(one, fabric_file, tmp_path / "c.usda", variants=variants)
    assert not (tmp_path / "c.usda").exists()


def test_packages(one, fabric_file, tmp_path):
    cloth, fabric = tmp_path / "cloth.usdz", tmp_path / "fabric.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(one), str(cloth))
    assert UsdUtils.CreateNewUsdzPackage(str(fabric_file), str(fabric))
    bind(cloth, fabric, tmp_path / "b.usda")
    assert fabrics_of(tmp_path / "b.usda") == {"/World/Cloth": {"Denim"}}
    assert check(tmp_path / "b.usda") == []


def test_what_payloads_and_variants_bring_is_bound(make, new_mesh, fabric_file, tmp_path):
    make(lambda s: new_mesh(s, "/World/Cloth", SQUARE, QUAD, UV), "part.usdc")

    def build(stage):
        prim = UsdGeom.Xform.Define(stage, "/World/Part").GetPrim()
        size = prim.GetVariantSets().AddVariantSet("size")
        size.AddVariant("large")
        size.SetVariantSelection("large")
        with size.GetVariantEditContext():
            prim.GetPayloads().AddPayload("./part.usdc")

    bound = bind(make(build), fabric_file, tmp_path / "b.usda")
    assert bound.targets == ("/World/Part/Cloth",)
    assert fabrics_of(tmp_path / "b.usda") == {"/World/Part/Cloth": {"Denim"}}


# --- what is refused ---


def test_files_that_are_read_are_not_written(one, fabric_file, tmp_path):
    over = tmp_path / "over.usda"
    bind(one, fabric_file, over)
    for out in (one, fabric_file, over):
        before = digest(out)
        with pytest.raises(UsdfabError, match="one that is read"):
            bind(over, fabric_file, out, overwrite=True)
        assert digest(out) == before
    with pytest.raises(UsdfabError, match="the file exists"):
        bind(one, fabric_file, over)


@pytest.mark.parametrize(
    ("prim", "problem"),
    [
        ("/World/Clot", "no such prim.*did you mean /World/Cloth"),
        ("World/Cloth", "no such prim.*did you mean /World/Cloth"),
        ("/World/Cloth.points", "not a prim path"),
        ("not a path", "not a prim path"),
        ("/", "no such prim|not a prim path"),
        ("/World/Empty", "this Xform is no mesh and holds none"),
        ("/World/Ball", "this Sphere is no mesh"),
        ("/World/Off", "deactivated"),
        ("/Class", "a class"),
        ("/Nothing", "an over of nothing"),
        ("/World/Cloth/Edges", "subset is one of edges"),
    ],
)
def test_unfit_prims(make, new_mesh, fabric_file, tmp_path, prim, problem):
    def build(stage):
        new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        UsdGeom.Xform.Define(stage, "/World/Empty")
        UsdGeom.Sphere.Define(stage, "/World/Ball")
        UsdGeom.Xform.Define(stage, "/World/Off").GetPrim().SetActive(False)
        stage.CreateClassPrim("/Class")
        stage.OverridePrim("/Nothing")
        UsdGeom.Subset.Define(stage, "/World/Cloth/Edges").CreateElementTypeAttr("edge")

    with pytest.raises(UsdfabError, match=problem):
        bind(make(build), fabric_file, tmp_path / "b.usda", prims=[prim])
    assert not (tmp_path / "b.usda").exists()


@pytest.mark.parametrize(
    ("collection", "problem"),
    [
        ("/World.collection:none", "no such collection.*the prim has empty"),
        ("/World", "no such collection"),
        ("/None.collection:empty", "no such prim"),
        ("/World.collection:empty", "no mesh in the collection.*/World/Cloth"),
    ],
)
def test_unfit_collections(make, new_mesh, fabric_file, tmp_path, collection, problem):
    def build(stage):
        new_mesh(stage, "/World/Cloth", SQUARE, QUAD, UV)
        Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "empty")

    with pytest.raises(UsdfabError, match=problem):
        bind(make(build), fabric_file, tmp_path / "b.usda", collections=[collection])


@pytest.mark.parametrize(
    "numbers",
    [{"rotate": float("nan")}, {"scale": 0.0}, {"scale": float("inf")}, {"meters_per_uv": -1.0}],
)
def test_numbers_out_of_range(one, fabric_file, tmp_path, numbers):
    with pytest.raises(UsdfabError, match="is not a"):
        bind(one, fabric_file, tmp_path / "b.usda", **numbers)


def test_a_stage_without_meshes_and_a_file_without_fabric(make, one, fabric_file, tmp_path):
    with pytest.raises(UsdfabError, match="no visible mesh"):
        bind(make(lambda s: None, "empty.usda"), fabric_file, tmp_path / "b.usda")
    with pytest.raises(UsdfabError, match="no fabric"):
        bind(one, one, tmp_path / "b.usda")


def test_what_usd_stumbles_over_is_an_error_of_the_users(one, fabric_file, tmp_path):
    text = one.read_text().replace(
        "int[] faceVertexCounts", "asset material:binding = @x@\n        int[] faceVertexCounts"
    )
    (tmp_path / "bad.usda").write_text(text)
    with pytest.raises(UsdfabError, match=r"bad.usda: USD cannot read it .*is not a relationship"):
        bind(tmp_path / "bad.usda", fabric_file, tmp_path / "b.usda")
    assert not (tmp_path / "b.usda").exists()


def test_nvidias_checker_agrees(one, fabric_file, tmp_path):
    nvidia = pytest.importorskip("usd_validation_nvidia")
    bind(one, fabric_file, tmp_path / "b.usda", rotate=10)
    logging.disable(logging.WARNING)
    issues = nvidia.ValidationEngine().validate(str(tmp_path / "b.usda")).issues()
    logging.disable(logging.NOTSET)
    assert [str(i) for i in issues] == []
