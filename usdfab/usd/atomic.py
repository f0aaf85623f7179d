"""Writing files whole or not at all: a temporary file beside the target, then a rename."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf

from usdfab.errors import UsdfabError

USD_SUFFIXES = (".usda", ".usdc", ".usd")


def checked_output(path: str | Path, *, overwrite: bool = False, suffixes: tuple[str, ...] = USD_SUFFIXES) -> Path:
    """``path`` if a file may be written there.

    Raises
    ------
    UsdfabError
        For a suffix that is not in ``suffixes``, a folder that does not exist or is not writable, a folder in the
        file's place, and an existing file unless ``overwrite``.
    """
    target = Path(path)
    place = str(target)
    if target.suffix.lower() not in suffixes:
        raise UsdfabError(f"cannot write '{target.suffix}' files", place=place, remedy=f"use {', '.join(suffixes)}")
    if not target.parent.is_dir():
        raise UsdfabError("the folder does not exist", place=place, remedy=f"create {target.parent} first")
    if target.is_dir():
        raise UsdfabError("a folder is in the file's place", place=place, remedy="choose another name")
    if target.exists() and not overwrite:
        raise UsdfabError("the file exists", place=place, remedy="choose another name or ask for overwriting")
    if not os.access(target.parent, os.W_OK):
        raise UsdfabError("the folder is not writable", place=place, remedy="choose another folder")
    return target


@contextmanager
def atomic_path(
    path: str | Path, *, overwrite: bool = False, suffixes: tuple[str, ...] = USD_SUFFIXES
) -> Iterator[Path]:
    """A temporary file name in the target's folder; what was written there becomes ``path`` when the block ends well.

    After an exception nothing is left behind and an existing file stays as it was. If USD holds the old file open in
    this process, its layer is reloaded.

    Raises
    ------
    UsdfabError
        As ``checked_output``, and when the disk or USD refuses.
    """
    target = checked_output(path, overwrite=overwrite, suffixes=suffixes)
    # The suffix stays last, since USD chooses the file format by it.
    temporary = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        try:
            yield temporary
            temporary.replace(target)
        except (OSError, Tf.ErrorException) as error:
            raise UsdfabError(f"cannot write the file ({_reason(error)})", place=str(target)) from error
    finally:
        temporary.unlink(missing_ok=True)
    stale = Sdf.Layer.Find(str(target))
    if stale:
        stale.Reload(force=True)


def export_layer(layer: Sdf.Layer, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write an Sdf layer to ``path`` atomically, in the format of its suffix. Returns the path."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        if not layer.Export(str(temporary)):
            raise OSError("USD could not export the layer")
    return Path(path)


def _reason(error: Exception) -> str:
    lines = str(getattr(error, "strerror", None) or error).strip().splitlines()
    return lines[-1].strip() if lines else type(error).__name__
