"""Opening stages, and saying where in a stage something is wrong."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf, Usd, UsdGeom

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.memory import bounded_memory
from usdfab.usd.registration import require_schema

GENERATOR = f"usdfab {__version__}"


def open_stage(source: str | Path | Usd.Stage) -> Usd.Stage:
    """The stage of a file, or the stage itself.

    Raises
    ------
    UsdfabError
        If the file is missing, a folder, or nothing that USD can read.
    """
    require_schema()
    if isinstance(source, Usd.Stage):
        return source
    path = Path(source)
    try:
        found = path.exists()
    except (OSError, ValueError) as error:
        raise UsdfabError(
            f"this is no file name ({getattr(error, 'strerror', None) or error})", place=str(path)
        ) from error
    if not found:
        raise UsdfabError("the file does not exist", place=str(path))
    if path.is_dir():
        raise UsdfabError("this is a folder, not a USD file", place=str(path))
    if not Sdf.FileFormat.FindByExtension(path.suffix):
        raise UsdfabError("this is not a USD file", place=str(path), remedy="USD files are .usda, .usdc, .usd, .usdz")
    if not os.access(path, os.R_OK):
        raise UsdfabError("the file is not readable", place=str(path), remedy="change its permissions")
    with bounded_memory(), readable(path):
        return Usd.Stage.Open(str(path))


@contextmanager
def readable(path: str | Path) -> Iterator[None]:
    """Turns what USD raises about a file's contents, at once or when it looks at a value, into ``UsdfabError``."""
    try:
        yield
    except Tf.ErrorException as error:
        raise UsdfabError(f"USD cannot read the file ({usd_reason(error)})", place=str(path)) from error
    except MemoryError as error:
        raise UsdfabError("USD needs more memory for this file than there is", place=str(path)) from error


def usd_reason(error: RuntimeError) -> str:
    """What went wrong first, without the place in USD's sources: ``'message'`` at the end of each line."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # USD quotes what it found, whatever bytes they are
        return "it holds bytes that are no text"
    messages = [m.strip() for m in re.findall(r" : '(.*?)'\s*(?=\n\s*Error in|\Z)", text, flags=re.DOTALL)]
    said = [m for m in messages if not m.startswith("Failed to open layer")] or messages or [text]
    return " ".join(said[0].split()) or "unreadable"


def stage_name(stage: Usd.Stage) -> str:
    """File name of a stage as people know it; ``anonymous`` for one in memory."""
    layer = stage.GetRootLayer()
    return "anonymous stage" if layer.anonymous else (layer.realPath or layer.identifier)


def site(stage: Usd.Stage, where: Any) -> str:
    """``file</prim.attr>`` for a prim, a property or a path."""
    path = where if isinstance(where, Sdf.Path) else where.GetPath()
    return f"{stage_name(stage)}<{path}>"


def new_stage(up_axis: str = "Z") -> Usd.Stage:
    """An in-memory stage in metres with its up axis, generator and metadata authored."""
    require_schema()
    stage = Usd.Stage.CreateInMemory()
    author_stage_metadata(stage, up_axis)
    return stage


def author_stage_metadata(stage: Usd.Stage, up_axis: str = "Z") -> None:
    """Author metersPerUnit = 1, kilogramsPerUnit = 1, the up axis and usdfab's generator mark."""
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if up_axis == "Z" else UsdGeom.Tokens.y)
    stage.SetMetadata("kilogramsPerUnit", 1.0)
    layer = stage.GetRootLayer()
    layer.customLayerData = {**layer.customLayerData, "usdfab": {"generator": GENERATOR}}


def has_geometry(stage: Usd.Stage) -> bool:
    """Whether the stage holds anything that could be drawn (a Gprim, an instancer), visible or not."""
    return any(
        prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    )
