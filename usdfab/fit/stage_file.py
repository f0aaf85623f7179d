"""Unfinished stages as files of arrays: saved whole or not at all, loaded without running anything (no pickle)."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.files import whole_file

Result = TypeVar("Result")


def save_stage(path: Path, kind: str, identity: str, arrays: Mapping[str, NDArray]) -> None:
    """Write a checkpoint. After an error an older file is still there and nothing else is.

    Parameters
    ----------
    kind:
        Of stage, with the version of its arrays.
    identity:
        Checksum of everything that the run depends on.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    about = np.array(json.dumps({"format": kind, "identity": identity}))
    try:
        with whole_file(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, about=about, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise UsdfabError(
            f"cannot be written ({error.strerror or error})", place=str(path), remedy="make room or use another disk"
        ) from error


def load_stage(path: Path, kind: str, identity: str, read: Callable[[dict[str, NDArray]], Result]) -> Result:
    """What ``read`` makes of the arrays that ``save_stage`` wrote for the same run.

    ``read`` raises ValueError, KeyError or TypeError for arrays that are none of this kind.

    Raises
    ------
    UsdfabError
        If the file is damaged, something else, or of another run.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            about = json.loads(str(data["about"]))
            if about["format"] != kind:
                raise ValueError
            found = about["identity"]
            result = read({name: data[name] for name in data.files if name != "about"})
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise UsdfabError(
            "this is no unfinished stage of this version, or it is damaged",
            place=str(path),
            remedy="remove it, or start anew with --overwrite",
        ) from error
    if found != identity:
        raise UsdfabError(
            "the unfinished stage is of another photo, other options or another start",
            place=str(path),
            remedy="give the same options, or start anew with --overwrite",
        )
    return result
