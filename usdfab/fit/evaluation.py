"""The analysis judged on a folder of labelled photos: ``python -m usdfab.fit.evaluation FOLDER``.

The folder holds ``SOURCES.csv`` with the columns ``file``, ``weave`` (plain, twill, satin, basket, other) and
``notes``; a note "about N yarns across horizontally and M vertically" gives the counts.
"""

from __future__ import annotations

import csv
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.imaging.image_file import read_image

TOLERANCE = 0.10
"""Relative error up to which a count is called right."""

_COUNTS = re.compile(r"about (\d+) yarns across horizontally and (\d+) vertically")


@dataclass(frozen=True)
class Row:
    """One photo: the label, the analysis (``None`` where it was refused, with the reason) and the time in seconds."""

    file: str
    weave: str
    warp_count: float | None
    weft_count: float | None
    analysis: PhotoAnalysis | None
    problem: str
    seconds: float

    @property
    def class_right(self) -> bool:
        """Whether the weave class equals the label."""
        return self.analysis is not None and self.analysis.weave_class == self.weave

    @property
    def count_errors(self) -> tuple[float | None, float | None]:
        """Relative errors of the warp and weft count; ``None`` without a label, -1 where the photo was refused."""
        if self.analysis is None:
            return tuple(None if t is None else -1.0 for t in (self.warp_count, self.weft_count))  # type: ignore[return-value]
        pairs = ((self.warp_count, self.analysis.warp_count), (self.weft_count, self.analysis.weft_count))
        warp, weft = (None if truth is None else estimate / truth - 1 for truth, estimate in pairs)
        return warp, weft


def read_photo(path: Path) -> NDArray[np.float64]:
    """A photo as linear RGB, (H, W, 3), row 0 at the top."""
    return read_image(path).pixels.astype(np.float64)


def evaluate_photos(folder: str | Path) -> list[Row]:
    """Analyse every photo of ``folder`` that its ``SOURCES.csv`` lists."""
    table = Path(folder) / "SOURCES.csv"
    if not table.is_file():
        raise UsdfabError("no such file", place=str(table), remedy="name a folder of photos with a SOURCES.csv")
    rows = []
    with table.open(newline="", encoding="utf-8") as stream:
        for record in csv.DictReader(stream):
            photo = read_photo(table.parent / record["file"])
            found = _COUNTS.search(record["notes"])
            warp, weft = (float(found[1]), float(found[2])) if found else (None, None)
            start = time.perf_counter()
            analysis, problem = None, ""
            try:
                analysis = analyze_photo(photo, record["file"])
            except UsdfabError as error:
                problem = error.problem
            seconds = time.perf_counter() - start
            rows.append(Row(record["file"], record["weave"], warp, weft, analysis, problem, seconds))
    return rows


def totals(rows: Sequence[Row]) -> tuple[int, int, int]:
    """Right classes, right counts (within :data:`TOLERANCE`), and the number of labelled counts."""
    errors = [e for row in rows for e in row.count_errors if e is not None]
    return sum(row.class_right for row in rows), sum(abs(e) <= TOLERANCE for e in errors), len(errors)


def format_rows(rows: Sequence[Row]) -> str:
    """The table as text, with totals."""
    head = f"{'file':<34}{'class':<8}{'found':<9}{'conf':>5}{'warp':>6}{'found':>7}{'err %':>7}{'conf':>6}"
    lines = [head + f"{'weft':>6}{'found':>7}{'err %':>7}{'conf':>6}{'lattice':>9}{'s':>6}"]
    for row in rows:
        a = row.analysis
        start = f"{row.file:<34}{row.weave:<8}"
        if a is None:
            lines.append(f"{start}refused: {row.problem}")
            continue
        text = f"{start}{a.weave_class + ('' if row.class_right else ' *'):<9}{a.weave_confidence:5.2f}"
        sides = ((row.warp_count, a.warp), (row.weft_count, a.weft))
        for (truth, system), error in zip(sides, row.count_errors, strict=True):
            known = f"{truth:6.0f}" if truth is not None else f"{'-':>6}"
            shown = "-" if error is None else f"{100 * error:.0f}{'*' if abs(error) > TOLERANCE else ''}"
            text += f"{known}{system.count:7.2f}{shown:>7}{system.count_confidence:6.2f}"
        lines.append(text + f"{a.lattice_confidence:9.2f}{row.seconds:6.1f}")
    classes, counts, labelled = totals(rows)
    lines.append(f"classes right: {classes} of {len(rows)}; counts within 10 %: {counts} of {labelled} (* = wrong)")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table for the folder named on the command line."""
    names = list(sys.argv[1:] if arguments is None else arguments)
    if len(names) != 1:
        print("usage: python -m usdfab.fit.evaluation FOLDER", file=sys.stderr)
        return 2
    try:
        print(format_rows(evaluate_photos(names[0])))
    except UsdfabError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
