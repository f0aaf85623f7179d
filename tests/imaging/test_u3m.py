"""U3M 1.1: what the format's description demands, checked on what is written."""

from __future__ import annotations

import json
import re
import struct
import zipfile
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest

from usdfab.fabric import weave_from_name
from usdfab.imaging.u3m import (
    Document,
    Physics,
    Texture,
    Visual,
    construction_of,
    document_json,
    file_name,
    write_u3m,
    write_u3ma,
)

WHEN = datetime(2026, 3, 4, 5, 6, 8, tzinfo=timezone.utc)
BASE = Texture("textures/front_albedo.png", (2.0, 4.0), (100, 200))
FRONT = Visual({"basecolor": BASE, "normal": BASE, "displacement": BASE}, {"roughness": 0.6}, (-0.1, 0.3), ior=1.5)
DOCUMENT = Document("Linen", FRONT, FRONT, Physics(0.4, None, "Plain weave"), WHEN, custom={"usdfab": {"seed": 3}})

SCALARS = {
    "alpha", "anisotropy_value", "anisotropy_rotation", "clearcoat_value", "clearcoat_roughness", "ior", "metalness",
    "displacement", "roughness", "sheen_value", "sheen_tint", "specular_value", "specular_tint", "subsurface_radius",
    "subsurface_value", "transmission",
}  # fmt: skip
COLORS, NORMALS = {"basecolor", "subsurface_color"}, {"normal", "clearcoat_normal"}


def check_document(content: dict[str, Any]) -> None:
    """The rules of U3M 1.1: which keys there are, their types and ranges. All must be there, none may be added."""
    assert content.keys() == {"schema", "material", "custom"} and content["schema"] == "1.1"
    material = content["material"]
    assert material.keys() == {
        "id", "name", "description", "created", "modified", "front", "back", "side", "physics", "metadata"
    }  # fmt: skip
    assert re.fullmatch(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}", material["id"])
    assert isinstance(material["name"], str) and material["name"]
    for key in ("created", "modified"):
        datetime.strptime(material[key], "%Y-%m-%dT%H:%M:%SZ")
    for side in ("front", "back", "side"):
        if material[side] is not None:
            check_visual(material[side])
    physics = material["physics"]
    assert physics.keys() == {"thickness", "weight", "composition", "devices", "material_type", "construction"}
    for key in ("thickness", "weight"):
        assert physics[key] is None or physics[key] >= 0
    assert physics["material_type"] == {"type": "Woven", "name": None}
    assert physics["devices"] == {"fab": "null"}
    assert physics["construction"] is None or physics["construction"].keys() == {"type", "name"}
    assert content["custom"] is None or isinstance(content["custom"], dict)


def check_visual(visual: dict[str, Any]) -> None:
    assert visual.keys() == SCALARS | COLORS | NORMALS | {"shader", "preview"}
    assert visual["shader"] == "principled"
    if visual["preview"] is not None:
        check_image(visual["preview"], repeats=False)
    for name in SCALARS | COLORS | NORMALS:
        parameter = visual[name]
        assert parameter.keys() == {"constant", "texture"}, name
        constant, texture = parameter["constant"], parameter["texture"]
        if name in SCALARS:
            assert isinstance(constant, float), name
        else:
            assert constant.keys() == set("rgb" if name in COLORS else "xyz")
            assert all(-1.0 <= v <= 1.0 and (v >= 0.0 or name in NORMALS) for v in constant.values())
        if name in ("alpha", "anisotropy_rotation", "metalness", "transmission"):
            assert 0.0 <= constant <= 1.0
        if texture is not None:
            extra = {"factor", "offset"} if name in SCALARS else {"factor", "mode"} if name in COLORS else {"scale"}
            assert texture.keys() == extra | {"image"}, name
            check_image(texture["image"])


def check_image(image: dict[str, Any], repeats: bool = True) -> None:
    assert image.keys() == {"path", "width", "height", "dpi"} | ({"repeat"} if repeats else set())
    assert image["width"] > 0 and image["height"] > 0 and image["dpi"].keys() == {"x", "y"}
    path = image["path"]
    assert not path.startswith(("/", ".", "~")) and ".." not in path and re.fullmatch(r"[0-9A-Za-z._/-]+", path)
    if repeats:
        assert image["repeat"].keys() == {"mode", "rotation"}
        assert image["repeat"]["mode"] in {"normal", "mirror_x", "mirror_y", "mirror_xy"}


def test_the_document_obeys_the_format() -> None:
    check_document(document_json(DOCUMENT))
    check_document(document_json(replace(DOCUMENT, back=None, custom={}, physics=Physics())))


def test_sizes_are_in_millimetres_and_dpi() -> None:
    content = document_json(DOCUMENT)["material"]
    image = content["front"]["basecolor"]["texture"]["image"]
    assert (image["width"], image["height"]) == (2.0, 4.0)
    assert image["dpi"] == {"x": pytest.approx(1270.0), "y": pytest.approx(1270.0)}
    displacement = content["front"]["displacement"]["texture"]
    assert (displacement["offset"], displacement["factor"]) == (-0.1, pytest.approx(0.4))
    assert content["physics"]["thickness"] == 0.4 and content["physics"]["weight"] is None
    # Reflectance at normal incidence on a scale from 0 to 8 %: index 1.5 reflects 4 %.
    assert content["front"]["specular_value"]["constant"] == pytest.approx(0.5)


def test_the_id_follows_from_the_content() -> None:
    first, again = document_json(DOCUMENT), document_json(DOCUMENT)
    assert first == again
    other = document_json(replace(DOCUMENT, custom={"usdfab": {"seed": 4}}))
    assert other["material"]["id"] != first["material"]["id"]


@pytest.mark.parametrize(
    ("weave", "name"),
    [
        ("plain", "Plain weave"),
        ("twill 3/1", "Twill - right hand (Z)"),
        ("twill 2/2 s", "Twill - left hand (S)"),
        ("satin 8/3", "Satin"),
        ("basket 2/2", "Canvas"),
        ("birdseye", "Dobby"),
    ],
)
def test_weaves_have_their_names_in_the_trade(weave: str, name: str) -> None:
    assert construction_of(weave_from_name(weave)) == name


def test_file_names_are_portable() -> None:
    assert file_name("Café / 50% wool:\\x") == "Caf_50_wool_x"
    assert file_name("..") == "Fabric"


def make_folder(folder: Path) -> Path:
    (folder / "textures").mkdir(parents=True)
    (folder / "textures" / "front_albedo.png").write_bytes(bytes(range(256)) * 3)
    write_u3m(DOCUMENT, folder)
    return folder


def test_the_folder_holds_the_json(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "linen")
    check_document(json.loads((folder / "Linen.u3m").read_text(encoding="utf-8")))


def test_the_archive_obeys_the_dialect(tmp_path: Path) -> None:
    """Any zip reader opens it; headers say what U3MA demands."""
    folder = make_folder(tmp_path / "linen")
    archive = write_u3ma(folder, tmp_path / "linen.u3ma", WHEN)
    with zipfile.ZipFile(archive) as opened:
        assert opened.testzip() is None
        assert opened.namelist() == ["Linen.u3m", "textures/front_albedo.png"]
        for entry in opened.infolist():
            assert opened.read(entry) == (folder / entry.filename).read_bytes()
            assert entry.date_time == (2026, 3, 4, 5, 6, 8)
            assert entry.flag_bits == 0x0800 and entry.compress_type in (0, 8) and not entry.extra
            assert (entry.create_version, entry.create_system, entry.extract_version) == (63, 0, 20)
            assert entry.external_attr == 0 and entry.internal_attr == 0 and entry.comment == b""
    raw = archive.read_bytes()
    assert raw[:4] == b"PK\x03\x04" and raw[-22:-18] == b"PK\x05\x06" and struct.unpack("<H", raw[-2:]) == (0,)
    assert write_u3ma(folder, tmp_path / "again.u3ma", WHEN).read_bytes() == raw
