"""A folder of results of many fits, one JSON file each: what is there is not worked out again, if it is of one run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from usdfab.errors import UsdfabError
from usdfab.files import whole_file


def made_folder(output: str | Path) -> Path:
    """The folder, made if it is missing.

    Raises
    ------
    UsdfabError
        If that is impossible.
    """
    target = Path(output)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(target)) from error
    return target


def read_result(record: Path, about: Mapping[str, Any]) -> dict[str, Any] | None:
    """What ``write_result`` wrote, or None where nothing is.

    Parameters
    ----------
    about:
        The options that it has to be of.

    Raises
    ------
    UsdfabError
        For a result of other options, and a file that is no result.
    """
    if not record.exists():
        return None
    try:
        data = json.loads(record.read_text(encoding="utf-8"))
        found = data.pop("about")
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise no_result(record) from error
    if found != json.loads(json.dumps(about)):
        raise UsdfabError(
            "this result is of other options", place=str(record), remedy="choose another folder for the output"
        )
    result: dict[str, Any] = data
    return result


def write_result(record: Path, about: Mapping[str, Any], result: Mapping[str, Any]) -> None:
    """Keep a result with the options that it is of.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    try:
        with whole_file(record) as temporary:
            temporary.write_text(json.dumps({"about": dict(about)} | dict(result)), encoding="utf-8")
    except OSError as error:
        raise UsdfabError(f"cannot be written ({error.strerror or error})", place=str(record)) from error


def no_result(record: Path) -> UsdfabError:
    """The error for a file that cannot be read as a result."""
    return UsdfabError("this is no result of a fit", place=str(record), remedy="remove the file")
