"""Files that a stage names: images of lights and materials."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Ar, Sdf, Usd

from usdfab.errors import UsdfabError

UDIM = "<UDIM>"


def relative_asset(file: str | Path, folder: str | Path) -> str:
    """The path by which a layer in ``folder`` names ``file``: with forward slashes, anchored by ``./`` or ``../``.

    Raises
    ------
    UsdfabError
        If there is none: both are on different drives.
    """
    try:
        found = Path(os.path.relpath(Path(file).resolve(), Path(folder).resolve())).as_posix()
    except ValueError as error:
        raise UsdfabError(
            f"there is no relative path to it from {folder}", place=str(file), remedy="keep both on one drive"
        ) from error
    # A bare name would be looked up on search paths too.
    return found if found.startswith(".") else f"./{found}"


def image_file(attribute: Usd.Attribute, time: Usd.TimeCode) -> str:
    """The file that an asset attribute names, resolved against the layer that names it; empty if it names none.

    Raises
    ------
    UsdfabError
        For a file that does not exist, one inside a ``.usdz`` package, and a set of UDIM tiles.
    """
    value = attribute.Get(time)
    if not isinstance(value, Sdf.AssetPath) or not value.path:
        return ""
    place = f"{attribute.GetPrim().GetPath()}.{attribute.GetName()}"
    if UDIM in value.path:
        raise UsdfabError("UDIM tiles are not supported", place=place, remedy="give one image")
    if not value.resolvedPath:
        raise UsdfabError(f"the image {value.path} does not exist", place=place)
    if Ar.IsPackageRelativePath(value.resolvedPath):
        raise UsdfabError(
            f"the image {value.path} is inside a package", place=place, remedy="unpack the .usdz file (usdzip, unzip)"
        )
    return str(value.resolvedPath)
