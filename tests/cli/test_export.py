"""``usdfab export`` from end to end, on maps of a few texels."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdShade

from usdfab.imaging import read_image
from usdfab.usd.check import check
from usdfab.usd.fabric_io import FABRIC_PATH, read_fabric

MAPS = ("albedo", "normal", "roughness", "height", "opacity", "orientation", "ao")
SMALL = ("--resolution", "16", "--rays", "8", "--threads", "1")


@pytest.fixture(scope="module")
def exported(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A folder with everything, made once, and what --json said."""
    import contextlib
    import io

    from usdfab.cli.main import _run

    folder = tmp_path_factory.mktemp("export") / "maps of tiny"
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = _run(["export", str(tiny), "-o", str(folder), *SMALL, "--materialx", "--back", "--json", "-q"])
    assert code == 0
    return folder, json.loads(out.getvalue())


def test_a_folder_holds_maps_layer_and_preview(exported: tuple[Path, dict]) -> None:
    folder, said = exported
    wanted = {f"maps/{side}{name}.png" for name in MAPS for side in ("", "back_")}
    wanted |= {"tiny_look.usda", "preview.png"}
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == wanted
    assert {Path(f).resolve() for f in said["files"]} == {(folder / w).resolve() for w in wanted}


def test_json_tells_the_scale(exported: tuple[Path, dict]) -> None:
    said = exported[1]
    assert said["schema"] == "usdfab/1" and said["meters_per_uv"] == 1.0
    assert said["front"]["size"] == pytest.approx([1e-3, 1e-3])
    assert said["front"]["resolution"] == [16, 16]
    assert said["front"]["heightLow"] < said["front"]["heightHigh"] < 1e-3
    assert np.shape(said["brightness"]["sky"]) == np.shape(said["brightness"]["lamp"]) == (3,)


def test_the_layer_is_sound_and_the_fabric_intact(exported: tuple[Path, dict], tiny: Path) -> None:
    layer = exported[0] / "tiny_look.usda"
    assert [i for i in check(layer) if i.severity == "error"] == []
    assert read_fabric(layer) == read_fabric(tiny)
    material = UsdShade.Material.Get(stage := Usd.Stage.Open(str(layer)), FABRIC_PATH)
    assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"
    assert material.ComputeSurfaceSource("mtlx")[0].GetIdAttr().Get() == "ND_open_pbr_surface_surfaceshader"
    assert stage.GetDefaultPrim().GetPath() == "/Looks"


def test_the_files_hold_what_was_baked(exported: tuple[Path, dict]) -> None:
    folder, said = exported
    size = read_image(folder / "maps" / "albedo.png").pixel_size
    assert size == pytest.approx((1e-3 / 16, 1e-3 / 16), rel=1e-3)
    assert 0.5 < said["front"]["coverage"] <= 1.0


def absolute(text: str) -> list[str]:
    found = [*re.findall(r"@([^@]*)@", text), *re.findall(r'"path": "([^"]*)"', text)]
    return [p for p in found if re.match(r"/|[A-Za-z]:|\\|file:", p)]


def scan(files: dict[str, bytes], place: Path) -> None:
    """No absolute path in any text, and the place where it was made nowhere at all."""
    for name, data in files.items():
        assert str(place).encode() not in data, name
        if name.endswith((".usda", ".u3m")):
            assert absolute(data.decode()) == [], name


def test_no_absolute_path_in_the_folder(exported: tuple[Path, dict], tiny: Path) -> None:
    files = {p.name: p.read_bytes() for p in exported[0].rglob("*") if p.is_file()}
    scan(files, tiny.parent)
    scan(files, exported[0].parent)


def test_some_maps_as_exr(run, tiny: Path, tmp_path: Path) -> None:
    code, out, _ = run("export", tiny, "-o", tmp_path / "m", *SMALL, "--maps", "height,albedo", "--format", "exr")
    assert code == 0 and out == ""
    assert {p.name for p in (tmp_path / "m" / "maps").iterdir()} == {"albedo.exr", "height.exr"}
    assert [i for i in check(tmp_path / "m" / "tiny_look.usda") if i.severity == "error"] == []


def test_a_usdz_opens_again(run, tiny: Path, tmp_path: Path) -> None:
    package = tmp_path / "tiny.usdz"
    code, _, err = run("export", tiny, "--usdz", "-o", package, *SMALL, "--format", "exr", "--meters-per-uv", "3mm")
    assert code == 0, err
    assert list(tmp_path.iterdir()) == [package], "nothing is left beside it"
    assert read_fabric(package) == read_fabric(tiny)
    assert [i for i in check(package) if i.severity == "error"] == []
    with zipfile.ZipFile(package) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    assert {Path(name).suffix for name in files} == {".usda", ".png"}
    scan(files, tmp_path)
    scan(files, tiny.parent)


@pytest.mark.parametrize("packed", [False, True])
def test_u3m_as_a_folder_and_packed(run, tiny: Path, tmp_path: Path, packed: bool) -> None:
    target = tmp_path / ("tiny.u3ma" if packed else "tiny")
    code, _, err = run("export", tiny, "--u3m", "-o", target, *SMALL)
    assert code == 0, err
    if packed:
        with zipfile.ZipFile(target) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
    else:
        files = {p.relative_to(target).as_posix(): p.read_bytes() for p in target.rglob("*") if p.is_file()}
    document = json.loads(files["Fabric.u3m"])
    front, back = document["material"]["front"], document["material"]["back"]
    for visual in (front, back):
        for parameter in visual.values():
            if isinstance(parameter, dict) and parameter.get("texture"):
                assert parameter["texture"]["image"]["path"] in files
    assert front["basecolor"]["texture"]["image"]["path"] != back["basecolor"]["texture"]["image"]["path"]
    assert front["basecolor"]["texture"]["image"]["width"] == pytest.approx(1.0)
    assert document["material"]["physics"]["construction"]["type"] == "Plain weave"
    assert 0.05 < document["material"]["physics"]["thickness"] < 2.0
    scan(files, tmp_path)
    # The format's baseline knows no grey pictures.
    for name, data in files.items():
        if name.endswith(".png"):
            assert data[25] == 2, f"{name} is RGB"


def test_nothing_is_overwritten_unasked(run, exported: tuple[Path, dict], tiny: Path) -> None:
    folder = exported[0]
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    code, out, err = run("export", tiny, "-o", folder, *SMALL)
    assert code == 2 and out == "" and "--overwrite" in err and len(err.strip().splitlines()) == 1
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("-o", "x.usda"), "folder"),
        (("-o", "x", "--usdz"), "format"),
        (("-o", "x.usdz", "--u3m"), "format"),
        (("-o", "x.usdz", "--u3m", "--usdz"), "twice"),
        (("-o", "x", "--maps", "albedo,gloss"), "gloss"),
        (("-o", "x", "--resolution", "1"), "texels"),
        (("-o", "x", "--repeats", "0x1"), "repeats"),
        (("-o", "x", "--rays", "0"), "rays"),
        (("-o", "x", "--meters-per-uv", "-1"), "above 0"),
        (("-o", "no/such/x"), "folder"),
    ],
)
def test_impossible_requests_are_one_line(run, tiny: Path, tmp_path: Path, monkeypatch, arguments, word) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run("export", tiny, *arguments)
    assert code == 2 and out == "" and word in err and len(err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_the_maps(run, tiny: Path, tmp_path: Path) -> None:
    code, _, _ = run("export", tiny, "-o", tmp_path / "m", *SMALL, "--screenshot", tmp_path / "sheet.png")
    assert code == 0
    picture = read_image(tmp_path / "sheet.png").pixels
    assert picture.shape[0] > 32 and picture.std() > 0.05
