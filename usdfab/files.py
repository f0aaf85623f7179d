"""Writing files whole or not at all: a temporary file beside the target, then a rename."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from usdfab.errors import UsdfabError


def checked_output(path: str | Path, suffixes: tuple[str, ...], *, overwrite: bool = False, kind: str = "") -> Path:
    """``path`` if a file may be written there. ``kind`` names what is written, e.g. ``"images"``.

    Raises
    ------
    UsdfabError
        For a suffix that is not in ``suffixes``, a folder that does not exist or is not writable, a folder in the
        file's place, and an existing file unless ``overwrite``.
    """
    target = Path(path)
    place = str(target)
    if target.suffix.lower() not in suffixes:
        what = kind or "files"
        raise UsdfabError(f"cannot write '{target.suffix}' {what}", place=place, remedy=f"use {', '.join(suffixes)}")
    if target.is_dir():
        raise UsdfabError("a folder is in the file's place", place=place, remedy="choose another name")
    if target.exists() and not overwrite:
        raise UsdfabError("the file exists", place=place, remedy="choose another name or use --overwrite")
    if not target.parent.is_dir():
        raise UsdfabError("the folder does not exist", place=place, remedy=f"create {target.parent} first")
    if not os.access(target.parent, os.W_OK):
        raise UsdfabError("the folder is not writable", place=place, remedy="choose another folder")
    return target


@contextmanager
def whole_file(target: Path) -> Iterator[Path]:
    """A temporary file name in the target's folder; what was written there becomes ``target`` when the block ends well.

    After an exception nothing is left behind and an existing file stays as it was.
    """
    # The suffix stays last, since image and USD libraries choose the format by it.
    temporary = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:12]}{target.suffix.lower()}")
    try:
        yield temporary
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
