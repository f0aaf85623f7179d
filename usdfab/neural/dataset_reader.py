"""Reading data sets of surface materials: what ``usdfab dataset neural`` wrote.

    dataset.json                      what all files share: version, kind, seed, counts, ranges, samples
    reflection-00012.safetensors      material 12: queries (Q, 8), targets (Q, 4), and the material as metadata
    transmission-00012.safetensors    the same material lit from below, with queries of its own

Queries and targets are those of ``aggregation.aggregate``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from usdfab.errors import UsdfabError
from usdfab.neural.surface_material import SurfaceMaterial, weave_from_bits

Kind = Literal["reflection", "transmission"]
KINDS: tuple[Kind, Kind] = ("reflection", "transmission")

MANIFEST = "dataset.json"
SCHEMA = "usdfab-neural-material/1"
"""Of each file, in its metadata."""

_REMEDY = "remove it and run `usdfab dataset neural` again: it is made anew"


def material_path(folder: str | Path, kind: Kind, index: int) -> Path:
    """The file of material ``index``."""
    return Path(folder) / f"{kind}-{index:05d}.safetensors"


def list_materials(folder: str | Path, kind: Kind) -> list[Path]:
    """The finished files of one kind, in the order of their numbers.

    Raises
    ------
    UsdfabError
        If the folder is no data set.
    """
    read_manifest(folder)
    paths = Path(folder).glob(f"{kind}-*.safetensors")
    return sorted(path for path in paths if path.stem.removeprefix(f"{kind}-").isdigit())


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """``dataset.json``.

    Raises
    ------
    UsdfabError
        If there is none, or it cannot be read.
    """
    path = Path(folder) / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsdfabError("there is no data set here", place=str(folder), remedy=f"no {MANIFEST} was found") from error
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    except ValueError as error:
        raise UsdfabError("the manifest is damaged", place=str(path), remedy="restore it from a copy") from error
    if not isinstance(manifest, dict) or not str(manifest.get("schema", "")).startswith("usdfab-neural-dataset/"):
        raise UsdfabError("this is no data set of surface materials", place=str(path))
    return manifest


def read_material(path: str | Path) -> tuple[SurfaceMaterial, NDArray[np.float32], NDArray[np.float32]]:
    """(material, queries (Q, 8), targets (Q, 4)) of one file.

    Raises
    ------
    UsdfabError
        If the file is missing, damaged, of another version, or holds numbers that no material has.
    """
    place = str(path)
    try:
        with safe_open(path, framework="numpy") as file:
            about = file.metadata() or {}
            if about.get("schema") != SCHEMA:
                raise UsdfabError(f"has format {about.get('schema')!r}, not {SCHEMA!r}", place=place)
            queries, targets = file.get_tensor("queries"), file.get_tensor("targets")
        material = material_of(about)
    except FileNotFoundError as error:
        raise UsdfabError("no such file", place=place) from error
    except UsdfabError as error:
        raise UsdfabError(error.problem, place=place if error.place in ("", place) else f"{place}: {error.place}",
                          remedy=error.remedy) from error  # fmt: skip
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise UsdfabError("the file is damaged or cut off", place=place, remedy=_REMEDY) from error
    shapes = queries.ndim == targets.ndim == 2 and len(queries) == len(targets)
    if not shapes or queries.shape[1] != 8 or targets.shape[1] != 4:
        raise UsdfabError("the file is damaged or cut off", place=place, remedy=_REMEDY)
    return material, queries.astype(np.float32, copy=False), targets.astype(np.float32, copy=False)


def material_metadata(material: SurfaceMaterial) -> dict[str, str]:
    """A material as text: ``weave_name``, ``weave`` (``SurfaceMaterial.bits``), ``twist``, ... numbers as JSON."""
    return {
        "weave_name": material.name,
        "weave": material.bits(),
        "twist": json.dumps(material.twist),
        "inclination": json.dumps(material.inclination),
        "roughness": json.dumps(material.roughness),
        "height_scale": json.dumps(material.height_scale),
        "gap": json.dumps(material.gap),
    }


def material_of(about: dict[str, str]) -> SurfaceMaterial:
    """The inverse of ``material_metadata``; KeyError, ValueError or UsdfabError for other text."""
    numbers = {name: json.loads(about[name]) for name in ("roughness", "height_scale", "gap")}
    pairs = {name: json.loads(about[name]) for name in ("twist", "inclination")}
    return SurfaceMaterial(weave_from_bits(about["weave"]), **pairs, **numbers, name=about["weave_name"])
