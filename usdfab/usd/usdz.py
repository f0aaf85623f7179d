"""Packing a USD file with everything that it names into one ``.usdz``."""

from __future__ import annotations

from pathlib import Path

from pxr import Sdf, Tf, UsdUtils

from usdfab.errors import UsdfabError
from usdfab.files import checked_output, whole_file

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Pictures that every reader of packages knows."""


def checked_usdz(path: str | Path, *, overwrite: bool = False) -> Path:
    """``path`` if a package may be written there; ``UsdfabError`` as ``usdfab.files.checked_output``."""
    return checked_output(path, (".usdz",), overwrite=overwrite, kind="packages")


def write_usdz(source: str | Path, out: str | Path, *, overwrite: bool = False) -> tuple[Path, list[str]]:
    """Pack ``source`` and all layers and pictures that it names.

    Returns
    -------
    path:
        ``out``.
    warnings:
        One sentence for each picture that not every reader of packages knows, and each asset that is missing.

    Raises
    ------
    UsdfabError
        If the output cannot be written, or USD refuses.
    """
    target = checked_usdz(out, overwrite=overwrite)
    _, assets, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(source)))
    warnings = [f"{Path(str(name)).name} does not exist, the package lacks it" for name in missing]
    for asset in assets:
        if Path(str(asset)).suffix.lower() not in PICTURE_SUFFIXES:
            warnings.append(f"{Path(str(asset)).name} is no PNG or JPEG; not every program reads it from a package")
    try:
        with whole_file(target) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(source)), str(temporary)):
                raise UsdfabError("USD could not write the package", place=str(target))
    except (OSError, Tf.ErrorException) as error:
        raise UsdfabError(
            f"the package cannot be written ({str(error).splitlines()[-1]})", place=str(target)
        ) from error
    return target, warnings
