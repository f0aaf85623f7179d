"""The layer that wires maps into a fabric's Material: for USD, for our own reader, for MaterialX, as a package."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import preset
from usdfab.imaging.texture_file import write_texture
from usdfab.usd.assets import relative_asset
from usdfab.usd.check import check
from usdfab.usd.fabric_io import FABRIC_PATH, read_fabric, read_meters_per_uv, write_fabric
from usdfab.usd.look_layer import MapLook, cloth_scale, without_fibers, write_look
from usdfab.usd.problems import Problems
from usdfab.usd.read_materials import read_material
from usdfab.usd.scene import Material
from usdfab.usd.usdz import write_usdz

SIZE = (2e-3, 4e-3)


def make_look(folder: Path, kind: str = "png", **changes) -> MapLook:
    """Maps of 4 x 8 texels."""
    folder.mkdir(exist_ok=True)
    color, grey = np.full((8, 4, 3), 0.5), np.full((8, 4), 0.25)
    maps = {"albedo": color, "normal": color, "roughness": grey, "opacity": grey, "height": grey}
    files = {
        name: write_texture(folder / f"{name}.{kind}", values, color=name == "albedo", overwrite=True)
        for name, values in maps.items()
    }
    values = {
        "files": files, "size": SIZE, "signed_normals": kind == "exr", "linear_albedo": kind == "exr",
        "albedo": (0.5, 0.5, 0.5), "roughness": 0.25, "opacity": 0.9, "ior": 1.6, "transmittance": (0.1, 0.2, 0.05),
        "fuzz": 0.02, "facts": {"size": list(SIZE), "ior": 1.6},
    }  # fmt: skip
    return MapLook(**(values | changes))


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "fabrics"
    folder.mkdir()
    return write_fabric(preset("linen"), folder / "linen.usda")


@pytest.fixture
def written(tmp_path: Path, source: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    return write_look(source, folder / "look.usda", make_look(folder / "maps"), materialx=True)


def as_seen_elsewhere(path: Path) -> Material:
    """The Material without usdfab's schema, by the reader that renders."""
    stage = Usd.Stage.Open(str(path))
    assert without_fibers(stage) == [FABRIC_PATH]
    return read_material(stage.GetPrimAtPath(FABRIC_PATH), Usd.TimeCode.Default(), Problems(strict=True)).material


def test_the_fabric_is_still_all_there(written: Path, source: Path) -> None:
    assert read_fabric(written) == read_fabric(source)


def test_the_users_file_is_not_touched(tmp_path: Path, source: Path) -> None:
    before = source.read_bytes()
    write_look(source, tmp_path / "look.usda", make_look(tmp_path / "maps"), materialx=True)
    assert source.read_bytes() == before


def test_the_maps_are_wired_as_they_are_encoded(written: Path) -> None:
    material = as_seen_elsewhere(written)
    assert set(material.textures) == {"diffuseColor", "roughness", "normal", "opacity"}
    linear = {name: texture.linear for name, texture in material.textures.items()}
    assert linear == {"diffuseColor": False, "roughness": True, "normal": True, "opacity": True}
    normal = material.textures["normal"]
    assert normal.scale[:3] == pytest.approx(2.0) and normal.bias[:3] == pytest.approx(-1.0)
    assert all(texture.wrap == ("repeat", "repeat") for texture in material.textures.values())
    assert all(Path(texture.file).is_file() for texture in material.textures.values())
    assert material.ior == pytest.approx(1.6)


def test_float_maps_are_taken_as_they_are(tmp_path: Path, source: Path) -> None:
    material = as_seen_elsewhere(
        write_look(source, tmp_path / "look.usda", make_look(tmp_path / "maps", "exr"), materialx=True)
    )
    assert material.textures["diffuseColor"].linear
    assert material.textures["normal"].scale[:3] == pytest.approx(1.0)
    assert material.textures["normal"].bias[:3] == pytest.approx(0.0)


@pytest.mark.parametrize(("asked", "expected"), [(None, 1.0), (0.3, 0.3)])
def test_maps_lie_in_real_size(tmp_path: Path, source: Path, asked: float | None, expected: float) -> None:
    """One unit of uv is so many metres: so many maps side by side, and the fibers agree."""
    path = write_look(source, tmp_path / "look.usda", make_look(tmp_path / "maps"), meters_per_uv=asked)
    for texture in as_seen_elsewhere(path).textures.values():
        transform = np.array([[expected / SIZE[0], 0.0, 0.0], [0.0, expected / SIZE[1], 0.0]])
        assert texture.uv_transform == pytest.approx(transform, rel=1e-6)
    assert read_meters_per_uv(path) == pytest.approx(asked or 0.0)


def test_the_fabrics_own_size_comes_before_the_default(tmp_path: Path) -> None:
    path = write_fabric(preset("linen"), tmp_path / "sized.usda", meters_per_uv=0.25)
    assert cloth_scale(path) == 0.25
    assert cloth_scale(path, meters_per_uv=2.0) == 2.0
    with pytest.raises(UsdfabError, match="above 0"):
        cloth_scale(path, meters_per_uv=0.0)


def test_closed_cloth_needs_no_transparency(tmp_path: Path, source: Path) -> None:
    path = write_look(source, tmp_path / "look.usda", make_look(tmp_path / "maps", opacity=1.0))
    assert "opacity" not in as_seen_elsewhere(path).textures


def test_validators_find_nothing(written: Path) -> None:
    assert [i for i in check(written) if i.severity == "error"] == []


def test_materialx_knows_every_node_and_input(written: Path) -> None:
    """Against MaterialX' own definitions: names, types, and that the surface ends on outputs:mtlx:surface."""
    mx = pytest.importorskip("MaterialX")
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    stage = Usd.Stage.Open(str(written))
    material = UsdShade.Material.Get(stage, FABRIC_PATH)
    surface, _, _ = material.ComputeSurfaceSource("mtlx")
    assert surface.GetIdAttr().Get() == "ND_open_pbr_surface_surfaceshader"
    types = {
        "color3f": "color3", "float3": "vector3", "float2": "vector2", "float": "float", "bool": "boolean",
        "string": "string", "asset": "filename",
    }  # fmt: skip
    nodes = 0
    for prim in stage.GetPrimAtPath(FABRIC_PATH).GetChildren():
        shader = UsdShade.Shader(prim)
        name = shader.GetIdAttr().Get()
        if not name.startswith("ND_"):
            continue
        nodes += 1
        definition = library.getNodeDef(name)
        assert definition is not None, name
        known = {i.getName(): i.getType() for i in definition.getActiveInputs()}
        for found in shader.GetInputs():
            assert known.get(found.GetBaseName()) == types[str(found.GetTypeName())], f"{name}.{found.GetBaseName()}"
    assert nodes >= 8
    # What is let through and what is reflected are not more than all.
    gain = UsdShade.Shader.Get(stage, f"{FABRIC_PATH}/MtlxBase").GetInput("in2").Get()[0]
    assert surface.GetInput("subsurface_weight").Get() == pytest.approx(0.2)
    assert gain * (1.0 - 0.2) == pytest.approx(1.0)
    assert surface.GetInput("geometry_thin_walled").Get() is True


def absolute_paths(text: str) -> list[str]:
    """Asset paths that begin with a slash, a drive or a scheme."""
    return [p for p in re.findall(r"@([^@]*)@", text) if re.match(r"/|[A-Za-z]:|\\|file:", p)]


def test_no_absolute_path_is_written(written: Path, tmp_path: Path) -> None:
    text = written.read_text()
    assert "@./maps/albedo.png@" in text and "@../fabrics/linen.usda@" in text
    assert absolute_paths(text) == [] and str(tmp_path) not in text


def test_the_folder_can_be_moved(written: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("out", "fabrics"):
        (tmp_path / name).rename(moved / name)
    assert as_seen_elsewhere(moved / "out" / "look.usda").textures.keys() >= {"diffuseColor"}
    assert read_fabric(moved / "out" / "look.usda").name == "LinenPlain"


def test_a_package_holds_all(written: Path, source: Path, tmp_path: Path) -> None:
    package, warnings = write_usdz(written, tmp_path / "linen.usdz")
    assert warnings == []
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
        assert {Path(n).suffix for n in names} <= {".usda", ".png"}
        assert sum(n.endswith(".png") for n in names) == 4, "all maps that are wired"
        for name in names:
            if name.endswith(".usda"):
                text = archive.read(name).decode()
                assert absolute_paths(text) == [] and str(tmp_path) not in text
    written.unlink()
    source.unlink()
    assert read_fabric(package) == preset("linen")
    stage = Usd.Stage.Open(str(package))
    file = UsdShade.Shader.Get(stage, f"{FABRIC_PATH}/AlbedoMap").GetInput("file").Get()
    assert file.resolvedPath, "the map is found in the package"
    assert [i for i in check(package) if i.severity == "error"] == []


def test_packages_are_not_overwritten_unasked(written: Path, tmp_path: Path) -> None:
    target = tmp_path / "linen.usdz"
    target.write_text("mine")
    with pytest.raises(UsdfabError, match="exists"):
        write_usdz(written, target)
    assert target.read_text() == "mine"
    write_usdz(written, target, overwrite=True)
    assert zipfile.is_zipfile(target)


def test_a_scene_keeps_its_metadata(tmp_path: Path, source: Path) -> None:
    stage = Usd.Stage.Open(str(source))
    stage.SetMetadata("upAxis", "Y")
    stage.SetStartTimeCode(3)
    stage.GetRootLayer().Save()
    layer = Sdf.Layer.FindOrOpen(str(write_look(source, tmp_path / "look.usda", make_look(tmp_path / "maps"))))
    assert layer.pseudoRoot.GetInfo("upAxis") == "Y" and layer.startTimeCode == 3 and layer.defaultPrim == "Looks"


def test_the_fabric_itself_is_never_the_output(source: Path, tmp_path: Path) -> None:
    with pytest.raises(UsdfabError, match="itself"):
        write_look(source, source, make_look(tmp_path / "maps"), overwrite=True)


def test_relative_asset_paths(tmp_path: Path) -> None:
    assert relative_asset(tmp_path / "a" / "b.png", tmp_path) == "./a/b.png"
    assert relative_asset(tmp_path / "b.png", tmp_path / "a") == "../b.png"
