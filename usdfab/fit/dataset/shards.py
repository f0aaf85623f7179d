"""Shards: tar files of samples, checked before anything of them is believed."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from pathlib import Path

from usdfab.errors import UsdfabError

_REMEDY = "remove it and run `usdfab dataset` again: its samples are made anew"
_END = 1024
"""A tar file ends with two empty blocks of 512 bytes."""


def check_shard(path: Path, count: int) -> list[tarfile.TarInfo]:
    """The members of a shard of ``count`` samples, in order, without reading their contents.

    Raises
    ------
    UsdfabError
        If the file is cut off, damaged, or holds other members than its name says.
    """
    try:
        shard = int(path.stem.removeprefix("shard-"))
        with tarfile.open(path, "r:") as tar:
            members = tar.getmembers()
            # getmembers() does not say that the last member's content, or the end mark, is missing.
            whole = not members or path.stat().st_size >= members[-1].offset_data + members[-1].size + _END
    except (tarfile.TarError, EOFError, ValueError) as error:
        raise UsdfabError("the shard is damaged or cut off", place=str(path), remedy=_REMEDY) from error
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    wanted = [f"{i:06d}.{kind}" for i in range(shard * count, (shard + 1) * count) for kind in ("exr", "json")]
    if not whole or [m.name for m in members] != wanted:
        raise UsdfabError("the shard is damaged or cut off", place=str(path), remedy=_REMEDY)
    return members


def read_shard(path: Path, count: int) -> Iterator[tuple[str, bytes, bytes]]:
    """(name, record, image) of all samples of a shard, in order. Errors as ``check_shard``, before the first."""
    members = check_shard(path, count)
    try:
        with path.open("rb") as file:
            for image, record in zip(members[::2], members[1::2], strict=True):
                content = []
                for member in (image, record):
                    file.seek(member.offset_data)
                    content.append(file.read(member.size))
                yield f"{path}/{record.name}", content[1], content[0]
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
