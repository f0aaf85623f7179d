"""UsdPreviewSurface with its textures, and what modulates the albedo of cloth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.usd.edit import edit_fabric
from usdfab.usd.fabric_io import read_fabric, write_fabric
from usdfab.usd.read_scene import read_scene

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
UV = [(x, y) for x, y, _ in SQUARE]
T = Sdf.ValueTypeNames


@pytest.fixture
def looks(tmp_path, new_mesh):
    """A stage on disk with a square that has a material of two nodes: ``(stage, surface, texture)``."""
    for name in ("wood.png", "wood.exr", "sub/far.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]], UV)
    material = UsdShade.Material.Define(stage, "/Look")
    surface = UsdShade.Shader.Define(stage, "/Look/S")
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", T.Token))
    texture = UsdShade.Shader.Define(stage, "/Look/T")
    texture.CreateIdAttr("UsdUVTexture")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return stage, surface, texture


def connect(surface, name, texture, output="rgb"):
    kind = T.Color3f if output == "rgb" else T.Float
    source = texture.CreateOutput(output, T.Float3 if output == "rgb" else T.Float)
    surface.CreateInput(name, kind).ConnectToSource(source)


def only_material(stage, **options):
    (material,) = read_scene(stage, **options).materials
    return material


def test_every_constant_input(looks):
    stage, surface, _ = looks
    material = only_material(stage)
    # the specification's defaults
    np.testing.assert_allclose(material.base_color, 0.18)
    assert (material.roughness, material.metallic, material.opacity, material.ior) == (0.5, 0.0, 1.0, 1.5)
    assert (material.clearcoat, material.clearcoat_roughness, material.opacity_threshold) == (0.0, 0.01, 0.0)
    assert material.specular_color is None and material.textures == {}
    np.testing.assert_array_equal(material.emissive, 0)
    for name, number in (
        ("roughness", 0.25), ("metallic", 0.75), ("opacity", 0.5), ("ior", 1.3), ("clearcoat", 0.6),
        ("clearcoatRoughness", 0.2), ("opacityThreshold", 0.1),
    ):  # fmt: skip
        surface.CreateInput(name, T.Float).Set(number)
    surface.CreateInput("emissiveColor", T.Color3f).Set(Gf.Vec3f(1, 2, 3))
    surface.CreateInput("specularColor", T.Color3f).Set(Gf.Vec3f(0.5, 0.25, 0))
    material = only_material(stage)
    found = (material.roughness, material.metallic, material.opacity, material.ior, material.clearcoat)
    assert found == pytest.approx((0.25, 0.75, 0.5, 1.3, 0.6))
    assert (material.clearcoat_roughness, material.opacity_threshold) == pytest.approx((0.2, 0.1))
    np.testing.assert_allclose(material.emissive, [1, 2, 3])
    assert material.specular_color is None
    surface.CreateInput("useSpecularWorkflow", T.Int).Set(1)
    material = only_material(stage)
    np.testing.assert_allclose(material.specular_color, [0.5, 0.25, 0])
    assert material.metallic == 0.0


def test_textures(looks, tmp_path):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set("./wood.png")
    connect(surface, "diffuseColor", texture)
    connect(surface, "roughness", texture, "g")
    connect(surface, "opacity", texture, "a")
    scene = read_scene(stage)
    found = scene.materials[0].textures
    assert set(found) == {"diffuseColor", "roughness", "opacity"}
    color, rough = found["diffuseColor"], found["roughness"]
    assert color.file == rough.file == str(tmp_path / "wood.png")
    assert (color.channels, rough.channels, found["opacity"].channels) == ("rgb", "g", "a")
    # auto: sRGB for colours, data for numbers
    assert (color.linear, rough.linear) == (False, True)
    assert color.wrap == ("black", "black")
    np.testing.assert_array_equal(color.scale, 1)
    np.testing.assert_array_equal(color.bias, 0)
    np.testing.assert_array_equal(color.uv_transform, np.eye(2, 3))
    texture.CreateInput("wrapS", T.Token).Set("repeat")
    texture.CreateInput("wrapT", T.Token).Set("mirror")
    texture.CreateInput("scale", T.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    texture.CreateInput("bias", T.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    color = only_material(stage).textures["diffuseColor"]
    assert color.wrap == ("repeat", "mirror")
    np.testing.assert_allclose(color.scale, [2, 2, 2, 1])
    np.testing.assert_allclose(color.bias, [-1, -1, -1, 0])


@pytest.mark.parametrize(
    ("file", "space", "linear"),
    [("wood.exr", "auto", True), ("wood.exr", "sRGB", False), ("wood.png", "raw", True), ("wood.png", "auto", False)],
)
def test_color_spaces(looks, file, space, linear):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set(f"./{file}")
    texture.CreateInput("sourceColorSpace", T.Token).Set(space)
    connect(surface, "diffuseColor", texture)
    assert only_material(stage).textures["diffuseColor"].linear == linear


def test_normal_maps_are_data(looks):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set("./wood.png")
    surface.CreateInput("normal", T.Normal3f).ConnectToSource(texture.CreateOutput("rgb", T.Float3))
    assert only_material(stage).textures["normal"].linear


def test_files_are_relative_to_the_layer_that_names_them(looks, tmp_path):
    stage, surface, texture = looks
    connect(surface, "diffuseColor", texture)
    layer = Sdf.Layer.CreateNew(str(tmp_path / "sub" / "look.usda"))
    stage.GetRootLayer().subLayerPaths.append("./sub/look.usda")
    with Usd.EditContext(stage, layer):
        texture.CreateInput("file", T.Asset).Set("./far.jpg")
    assert only_material(stage).textures["diffuseColor"].file == str(tmp_path / "sub" / "far.jpg")


def reader(stage, path, varname):
    node = UsdShade.Shader.Define(stage, path)
    node.CreateIdAttr("UsdPrimvarReader_float2")
    node.CreateInput("varname", T.String).Set(varname)
    return node.CreateOutput("result", T.Float2)


def test_coordinates(looks):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set("./wood.png")
    connect(surface, "diffuseColor", texture)
    outputs = [reader(stage, "/Look/R", "st")]
    for name, scale, turn, shift in (("X", (2, 3), 90.0, (0.1, 0.2)), ("Y", (1, 1), 0.0, (5, 0))):
        node = UsdShade.Shader.Define(stage, f"/Look/{name}")
        node.CreateIdAttr("UsdTransform2d")
        node.CreateInput("scale", T.Float2).Set(Gf.Vec2f(*scale))
        node.CreateInput("rotation", T.Float).Set(turn)
        node.CreateInput("translation", T.Float2).Set(Gf.Vec2f(*shift))
        node.CreateInput("in", T.Float2).ConnectToSource(UsdShade.Output(outputs[-1]))
        outputs.append(node.CreateOutput("result", T.Float2))
    texture.CreateInput("st", T.Float2).ConnectToSource(UsdShade.Output(outputs[-1]))
    scene = read_scene(stage)
    assert scene.warnings == ()
    # (1, 0) -> scaled (2, 0) -> turned (0, 2) -> moved (0.1, 2.2) -> moved (5.1, 2.2)
    found = scene.materials[0].textures["diffuseColor"].uv_transform
    np.testing.assert_allclose(found @ [1, 0, 1], [5.1, 2.2], atol=1e-6)
    np.testing.assert_allclose(found @ [0, 1, 1], [2.1, 0.2], atol=1e-6)


def test_the_primvar_that_the_material_reads_is_taken(looks):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set("./wood.png")
    connect(surface, "diffuseColor", texture)
    varname = reader(stage, "/Look/R", "second")
    texture.CreateInput("st", T.Float2).ConnectToSource(UsdShade.Output(varname))
    scene = read_scene(stage)
    assert scene.warnings == ("/M: /Look reads 'second', the mesh's 'st' is used",)
    second = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/M")).CreatePrimvar("second", T.TexCoord2fArray, "vertex")
    second.Set([Gf.Vec2f(7, 7)] * 4)
    scene = read_scene(stage)
    assert scene.warnings == () and scene.meshes[0].uv[0, 0, 0] == 7
    for name in ("st", "second"):
        UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/M")).RemovePrimvar(name)
    assert read_scene(stage).warnings == ("/M: /Look has textures, the mesh no texture coordinates",)


@pytest.mark.parametrize(
    ("file", "problem"),
    [("./gone.png", "the image ./gone.png does not exist"), ("./wood.<UDIM>.png", "UDIM tiles are not supported")],
)
def test_missing_images_fall_back(looks, file, problem):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set(file)
    texture.CreateInput("fallback", T.Float4).Set(Gf.Vec4f(0.25, 0.5, 0.75, 1))
    connect(surface, "diffuseColor", texture)
    connect(surface, "roughness", texture, "b")
    scene = read_scene(stage)
    assert scene.materials[0].textures == {}
    np.testing.assert_allclose(scene.materials[0].base_color, [0.25, 0.5, 0.75])
    assert scene.materials[0].roughness == 0.75
    assert scene.warnings[0] == f"/Look/T.inputs:file: {problem}; diffuseColor is 0.25, 0.5, 0.75"
    with pytest.raises(UsdfabError, match=problem):
        read_scene(stage, strict=True)


def test_bad_values_have_the_default(looks):
    stage, surface, _ = looks
    surface.CreateInput("diffuseColor", T.Color3f).Set(Gf.Vec3f(math.nan, 0, 0))
    surface.CreateInput("roughness", T.String).Set("rough")
    scene = read_scene(stage)
    np.testing.assert_allclose(scene.materials[0].base_color, 0.18)
    assert scene.materials[0].roughness == 0.5
    assert [w.partition(":")[0] for w in scene.warnings] == ["/Look/S.inputs"] * 2
    with pytest.raises(UsdfabError, match=r"/Look/S\.inputs:diffuseColor: expected 3 finite numbers"):
        read_scene(stage, strict=True)


def test_coordinates_that_run_in_a_circle(looks):
    stage, surface, texture = looks
    texture.CreateInput("file", T.Asset).Set("./wood.png")
    connect(surface, "diffuseColor", texture)
    node = UsdShade.Shader.Define(stage, "/Look/X")
    node.CreateIdAttr("UsdTransform2d")
    output = node.CreateOutput("result", T.Float2)
    node.CreateInput("in", T.Float2).ConnectToSource(output)
    texture.CreateInput("st", T.Float2).ConnectToSource(output)
    scene = read_scene(stage)
    assert "run in a circle" in " ".join(scene.warnings)


# --- the colour of cloth ---------------------------------------------------------------------------------------------


ALBEDO = {
    "constant": ([(0.5, 0.25, 1)], [[(0.5, 0.25, 1)] * 3] * 2),
    "uniform": ([(1, 0, 0), (0, 1, 0)], [[(1, 0, 0)] * 3, [(0, 1, 0)] * 3]),
    "vertex": ([(k / 4, 0, 0) for k in range(4)], [[(k / 4, 0, 0) for k in f] for f in ((0, 1, 2), (0, 2, 3))]),
    "faceVarying": ([(k / 8, 0, 0) for k in range(6)], [[(k / 8, 0, 0) for k in range(j, j + 3)] for j in (0, 3)]),
}


@pytest.mark.parametrize("interpolation", ALBEDO)
def test_albedo_primvar(cloth_stage, new_mesh, interpolation):
    values, expected = ALBEDO[interpolation]
    mesh = new_mesh(cloth_stage, "/World/Cloth", SQUARE, [[0, 1, 2], [0, 2, 3]], UV)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("usdfab:albedo", T.Color3fArray, interpolation)
    primvar.Set([Gf.Vec3f(*v) for v in values])
    np.testing.assert_allclose(read_scene(cloth_stage).meshes[0].albedo, expected)
    primvar.Set([Gf.Vec3f(-1, 0, 0)] * len(values))
    scene = read_scene(cloth_stage)
    assert scene.meshes[0].albedo is None and "an albedo is below 0" in scene.warnings[0]


def test_albedo_map(tmp_path, fabric, new_mesh):
    (tmp_path / "maps").mkdir()
    (tmp_path / "looks").mkdir()
    file = tmp_path / "maps" / "stripes.png"
    file.write_bytes(b"")
    mapped = edit_map(fabric, str(file))
    path = write_fabric(mapped, tmp_path / "looks" / "f.usda")
    # relative in the file, whole when read
    assert "@../maps/stripes.png@" in path.read_text()
    assert read_fabric(path) == mapped
    edit_fabric(path, {"seed": "3"}, tmp_path / "g.usda")
    assert "@./maps/stripes.png@" in (tmp_path / "g.usda").read_text()
    stage = Usd.Stage.CreateNew(str(tmp_path / "s.usda"))
    mesh = new_mesh(stage, "/M", SQUARE, [[0, 1, 2, 3]], UV)
    prim = stage.DefinePrim("/F")
    prim.GetReferences().AddReference("./looks/f.usda", "/Looks/Fabric")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material(prim))
    (surface,) = read_scene(stage).fabrics
    assert surface.albedo_map.file == str(file)
    assert surface.albedo_map.wrap == ("repeat", "repeat") and not surface.albedo_map.linear
    # a fabric that is put on in its place brings its own map, or none
    assert read_scene(stage, fabric_override=preset("denim")).fabrics[0].albedo_map is None
    file.unlink()
    scene = read_scene(stage)
    assert scene.fabrics[0].albedo_map is None
    assert f"the albedo map {file} does not exist" in scene.warnings[0]
    with pytest.raises(UsdfabError, match=r"albedo map .* does not exist"):
        read_scene(stage, strict=True)


def edit_map(fabric, file):
    from dataclasses import replace

    return replace(fabric, albedo_map=file)


def test_fabrics_without_a_map(tmp_path, fabric):
    path = write_fabric(fabric, tmp_path / "f.usda")
    assert read_fabric(path).albedo_map == ""
    assert "albedoMap" not in path.read_text()
