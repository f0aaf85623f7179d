"""U3M 1.1, the exchange format for digital materials of garment programs (github.com/vizoogmbh/u3m).

A folder ``NAME/`` with ``NAME.u3m`` (JSON), ``textures/`` and a preview, or the same packed as ``NAME.u3ma``, a narrow
dialect of zip. Lengths are in millimetres, resolutions in DPI, paths relative. All keys must be there; what is not
known is null, or a parameter's default.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric import Weave
from usdfab.files import checked_output, whole_file

VERSION = "1.1"
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Texture:
    """A picture of a U3M: its place relative to the JSON file, the cloth that it shows in mm, its texels."""

    path: str
    size_mm: tuple[float, float]
    pixels: tuple[int, int]

    def image(self) -> dict[str, Any]:
        """The JSON object, of a texture that repeats."""
        return self.preview() | {"repeat": {"mode": "normal", "rotation": 0.0}}

    def preview(self) -> dict[str, Any]:
        """The JSON object of a picture that does not repeat."""
        width, height = self.size_mm
        return {
            "path": self.path,
            "width": width,
            "height": height,
            "dpi": {"x": 25.4 * self.pixels[0] / width, "y": 25.4 * self.pixels[1] / height},
        }


@dataclass(frozen=True)
class Visual:
    """One side of the cloth.

    Parameters
    ----------
    textures:
        By U3M's names: basecolor, normal, roughness, alpha, displacement, anisotropy_rotation, anisotropy_value.
    constants:
        Means of the maps, by the same names, for programs without textures; basecolor (3,) linear, displacement in mm.
    displacement: mm
        What black and white of its texture stand for.
    """

    textures: Mapping[str, Texture]
    constants: Mapping[str, Any]
    displacement: tuple[float, float] = (0.0, 1.0)
    ior: float = 1.4
    transmission: float = 0.0
    sheen: float = 0.0
    preview: Texture | None = None


@dataclass(frozen=True)
class Physics:
    """What is known of the cloth as a thing; None where it is not."""

    thickness_mm: float | None = None
    weight_g_per_m2: float | None = None
    construction: str | None = None


@dataclass(frozen=True)
class Document:
    """A whole U3M. ``when`` is when the material was made; ``custom`` is anybody's plain data."""

    name: str
    front: Visual
    back: Visual | None
    physics: Physics
    when: datetime
    description: str = ""
    custom: Mapping[str, Any] = field(default_factory=dict)


_NUMBERS: dict[str, float] = {
    "alpha": 1.0, "anisotropy_value": 0.0, "anisotropy_rotation": 0.0, "clearcoat_value": 0.0,
    "clearcoat_roughness": 0.0, "ior": 1.4, "metalness": 0.0, "displacement": 0.0, "roughness": 0.7, "sheen_value": 0.0,
    "sheen_tint": 0.0, "specular_value": 0.5, "specular_tint": 0.0, "subsurface_radius": 0.0, "subsurface_value": 0.0,
    "transmission": 0.0,
}  # fmt: skip
"""Parameters that are numbers, with the format's defaults."""


def document_json(document: Document) -> dict[str, Any]:
    """The content of the ``.u3m`` file. The id follows from all the rest: the same material has the same one."""
    when = document.when.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
    physics = document.physics
    construction = None if physics.construction is None else {"type": physics.construction, "name": None}
    material: dict[str, Any] = {
        "name": document.name or "Fabric",
        "description": document.description,
        "created": when,
        "modified": when,
        "front": _visual(document.front),
        "back": None if document.back is None else _visual(document.back),
        "side": None,
        "physics": {
            "thickness": physics.thickness_mm,
            "weight": physics.weight_g_per_m2,
            "composition": None,
            "devices": {"fab": "null"},
            "material_type": {"type": "Woven", "name": None},
            "construction": construction,
        },
        "metadata": None,
    }
    custom = dict(document.custom)
    material["id"] = _uuid4(json.dumps([material, custom], sort_keys=True))
    return {"schema": VERSION, "material": material, "custom": custom or None}


def _visual(visual: Visual) -> dict[str, Any]:
    numbers = _NUMBERS | {"ior": visual.ior, "transmission": visual.transmission, "sheen_value": visual.sheen}
    # F0 on a scale on which 1 is 8 %.
    numbers["specular_value"] = min(((visual.ior - 1.0) / (visual.ior + 1.0)) ** 2 / 0.08, 1.0)
    result: dict[str, Any] = {}
    for name, default in numbers.items():
        texture = visual.textures.get(name)
        low, high = visual.displacement if name == "displacement" else (0.0, 1.0)
        result[name] = {
            "constant": float(visual.constants.get(name, default)),
            "texture": texture and {"image": texture.image(), "factor": high - low, "offset": low},
        }
    flat = {"x": 0.0, "y": 0.0, "z": 1.0}
    normal = visual.textures.get("normal")
    result["normal"] = {"constant": flat, "texture": normal and {"image": normal.image(), "scale": 1.0}}
    result["clearcoat_normal"] = {"constant": flat, "texture": None}
    color, base = visual.constants.get("basecolor", (0.5, 0.5, 0.5)), visual.textures.get("basecolor")
    white = {"r": 1.0, "g": 1.0, "b": 1.0}
    result["basecolor"] = {
        "constant": _rgb(color),
        "texture": base and {"image": base.image(), "factor": white, "mode": "multiply"},
    }
    result["subsurface_color"] = {"constant": _rgb(color), "texture": None}
    result["shader"] = "principled"
    result["preview"] = visual.preview and visual.preview.preview()
    return result


def _rgb(color: Color) -> dict[str, float]:
    return {name: min(max(float(value), 0.0), 1.0) for name, value in zip("rgb", color, strict=True)}


def _uuid4(text: str) -> str:
    """A UUID of version 4 whose random bits are a hash of ``text``."""
    digits = bytearray(hashlib.sha256(text.encode()).digest()[:16])
    digits[6] = digits[6] & 0x0F | 0x40
    digits[8] = digits[8] & 0x3F | 0x80
    text = digits.hex()
    return f"{text[:8]}-{text[8:12]}-{text[12:16]}-{text[16:20]}-{text[20:]}"


def file_name(name: str) -> str:
    """``name`` as a file name that every system takes."""
    return re.sub(r"[^0-9A-Za-z_-]+", "_", name).strip("_")[:100] or "Fabric"


def write_u3m(document: Document, folder: Path, *, overwrite: bool = False) -> Path:
    """Write ``folder/NAME.u3m`` beside the textures that are already there; returns the file."""
    content = document_json(document)
    target = checked_output(folder / f"{file_name(document.name)}.u3m", (".u3m",), overwrite=overwrite)
    with whole_file(target) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return target


def write_u3ma(folder: Path, path: Path, when: datetime, *, overwrite: bool = False) -> Path:
    """Pack all files of ``folder`` as a ``.u3ma``.

    The format is stricter than zip: names are marked as UTF-8, times are UTC, sizes stand in front of the data, and
    there are no attributes, comments and extra fields, which no option of ``zipfile`` does.
    """
    target = checked_output(path, (".u3ma",), overwrite=overwrite)
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    time = when.astimezone(timezone.utc)
    day = max(time.year - 1980, 0) << 9 | time.month << 5 | time.day
    clock = time.hour << 11 | time.minute << 5 | time.second // 2
    body, directory = bytearray(), bytearray()
    for file in files:
        name, raw = file.relative_to(folder).as_posix().encode(), file.read_bytes()
        packer = zlib.compressobj(6, zlib.DEFLATED, -15)
        packed = packer.compress(raw) + packer.flush()
        method, data = (8, packed) if len(packed) < len(raw) else (0, raw)
        fields = struct.pack("<4H3I2H", 0x0800, method, clock, day, zlib.crc32(raw), len(data), len(raw), len(name), 0)
        directory += struct.pack("<I2H", 0x02014B50, 0x003F, 0x14) + fields
        directory += struct.pack("<3H2I", 0, 0, 0, 0, len(body)) + name
        body += struct.pack("<IH", 0x04034B50, 0x14) + fields + name + data
    if len(body) + len(directory) >= 2**32 or len(files) >= 2**16:
        raise UsdfabError("the material is too large for this format", place=str(path), remedy="lower --resolution")
    end = struct.pack("<I4H2IH", 0x06054B50, 0, 0, len(files), len(files), len(directory), len(body), 0)
    with whole_file(target) as temporary:
        temporary.write_bytes(bytes(body + directory + end))
    return target


def construction_of(weave: Weave) -> str:
    """The format's name for a weave."""
    family = weave.classify()
    if family == "twill":
        matrix = weave.reduced().matrix
        return "Twill - right hand (Z)" if np.array_equal(np.roll(matrix[0], 1), matrix[1]) else "Twill - left hand (S)"
    return {"plain": "Plain weave", "satin": "Satin", "basket": "Canvas"}.get(family, "Dobby")
