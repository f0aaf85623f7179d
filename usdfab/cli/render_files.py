"""Which files a render writes, and what is already there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from usdfab.errors import UsdfabError
from usdfab.files import checked_output

PART_SUFFIX, PARTIAL_SUFFIX = ".part", ".partial"


@dataclass(frozen=True)
class RenderFile:
    """One picture to render.

    ``picture`` is its name, ``output`` the file that is written: the picture, or one part of it. ``partial`` is where
    the unfinished render is kept. ``finished``: there is nothing to do.
    """

    picture: Path
    output: Path
    partial: Path
    time_code: float | None
    finished: bool


def part_path(picture: Path, part: tuple[int, int]) -> Path:
    """``out.exr.03of16.part`` for part 3 of 16 of ``out.exr``."""
    i, n = part
    return picture.with_name(f"{picture.name}.{i:0{len(str(n))}d}of{n}{PART_SUFFIX}")


def plan_files(
    pictures: Sequence[tuple[Path, float | None]],
    part: tuple[int, int] | None,
    checkpoint: Path | None,
    resume: bool,
    overwrite: bool,
) -> list[RenderFile]:
    """Files for pictures (name, time code), checked before any work.

    Raises
    ------
    UsdfabError
        For names that cannot be written, files that exist, and unfinished renders that would be lost.
    """
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES

    files = []
    for picture, time_code in pictures:
        checked_output(picture, OUTPUT_SUFFIXES, overwrite=True, kind="images")
        output = part_path(picture, part) if part else picture
        partial = checkpoint or output.with_name(output.name + PARTIAL_SUFFIX)
        checked_output(partial, (partial.suffix.lower(),), overwrite=True)
        if partial == output:
            raise UsdfabError("is the output itself", place="--checkpoint", remedy="choose another name")
        finished = resume and output.exists() and not partial.exists() and not overwrite
        if not finished:
            checked_output(output, (output.suffix.lower(),), overwrite=overwrite)
        if partial.exists() and not (resume or overwrite):
            raise UsdfabError(
                "an unfinished render is there",
                place=str(partial),
                remedy="go on with --resume or start anew with --overwrite",
            )
        files.append(RenderFile(picture, output, partial, time_code, finished))
    return files
