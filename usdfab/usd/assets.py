"""Files that a stage names: images of lights and materials."""

from __future__ import annotations

from pxr import Ar, Sdf, Usd

from usdfab.errors import UsdfabError

UDIM = "<UDIM>"


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
