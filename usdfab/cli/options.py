"""Options and habits that the commands share."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from usdfab.errors import UsdfabError

Output = Annotated[Path, Parameter(name=["--output", "-o"], help="File to write.")]
OptionalOutput = Annotated[Path | None, Parameter(name=["--output", "-o"], help="File to write.")]
Overwrite = Annotated[bool, Parameter(negative="", help="Replace existing files.")]
Json = Annotated[bool, Parameter(name="--json", negative="", help="Print the result as JSON on stdout.")]
Seed = Annotated[int, Parameter(help="Fixes every random number.")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative="", help="No progress and no talk.")]
Resolution = Annotated[str, Parameter(help="WIDTHxHEIGHT in pixels, or WIDTH alone.")]
Denoise = Annotated[
    bool, Parameter(negative="", help="Remove the noise of few samples (biased; needs the denoise extra).")
]
Aov = Annotated[
    list[str] | None,
    Parameter(
        consume_multiple=True,
        negative="",
        help="EXR only: further layers; bare for all, or of depth, normal, albedo, fiber_id, yarn_id, uv, direct, "
        "indirect, samples, variance, alpha.",
    ),
]
Exposure = Annotated[float | None, Parameter(help="Not for EXR: stops to brighten the picture by.")]
View = Annotated[
    str | None, Parameter(help="Not for EXR: standard (clipped, the default) or reinhard (highlights roll off).")
]
Threads = Annotated[int | None, Parameter(help="Threads to use; all by default.")]

JSON_SCHEMA = "usdfab/1"
"""Version of what ``--json`` prints; raised when a key changes its meaning."""


def say(text: str) -> None:
    """Talk to the person at the terminal."""
    print(text, file=sys.stderr, flush=True)


def print_json(result: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    print(json.dumps({"schema": JSON_SCHEMA} | result, indent=2, default=str))


def parse_resolution(text: str) -> tuple[int, int]:
    """(width, height) from ``1280x720`` or ``720``; a height of 0 follows the camera's aspect."""
    parts = text.lower().split("x")
    try:
        numbers = [int(p) for p in parts]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 2 or any(n < 1 for n in numbers):
        raise UsdfabError(f"'{text}' is no resolution", place="--resolution", remedy="write e.g. 1280x720 or 720")
    return numbers[0], numbers[1] if len(numbers) == 2 else 0


@dataclass(frozen=True)
class Region:
    """A window of a picture: four numbers, each in pixels or, where ``percent``, in hundredths of width or height."""

    corners: tuple[float, float, float, float]
    percent: tuple[bool, bool, bool, bool]

    def pixels(self, width: int, height: int) -> tuple[int, int, int, int]:
        """(x0, y0, x1, y1) in a picture of this size, rounded to whole pixels."""
        sizes = (width, height, width, height)
        x0, y0, x1, y1 = (
            round(c * size / 100 if percent else c)
            for c, percent, size in zip(self.corners, self.percent, sizes, strict=True)
        )
        return x0, y0, x1, y1


def parse_region(text: str | None, option: str = "--region") -> Region | None:
    """``10,20,200,100`` in pixels from the top left, upper ends excluded, or ``25%,25%,75%,75%``."""
    if text is None:
        return None
    parts = [re.fullmatch(r"(\d+(?:\.\d+)?)(%?)", part.strip()) for part in text.split(",")]
    found = [(float(part[1]), bool(part[2])) for part in parts if part]
    whole = all(percent or number.is_integer() for number, percent in found)
    if len(parts) != 4 or len(found) != 4 or not whole:
        raise UsdfabError(
            f"'{text}' is no region", place=option, remedy="write x0,y0,x1,y1 in pixels or e.g. 25%,25%,75%,75%"
        )
    (a, b, c, d), (p, q, r, s) = zip(*found, strict=True)
    return Region((a, b, c, d), (p, q, r, s))


def frame_path(pattern: Path, frame: float) -> Path:
    """A frame's file: ``out.####.exr`` and ``out.%04d.exr`` are filled in, ``out.exr`` becomes ``out.0007.exr``.

    Between whole frames the decimals follow: ``out.0007.5.exr``.
    """
    whole, _, decimals = f"{abs(frame):.9f}".rstrip("0").partition(".")

    def digits(width: int) -> str:
        return f"{'-' if frame < 0 else ''}{whole.zfill(width)}{'.' if decimals else ''}{decimals}"

    name, count = re.subn(r"#+", lambda m: digits(len(m[0])), pattern.name)
    if not count:
        name, count = re.subn(r"%(?:0?(\d+))?d", lambda m: digits(int(m[1] or 1)), pattern.name)
    return pattern.with_name(name if count else f"{pattern.stem}.{digits(4)}{pattern.suffix}")


def parse_tile(text: str | None) -> tuple[int, int] | None:
    """(i, n) from ``i/n``, 1 <= i <= n."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise UsdfabError(f"'{text}' is no tile", place="--tile", remedy="write i/n with i from 1 to n, e.g. 2/8")
    return int(match[1]), int(match[2])


@contextmanager
def progress_bar(what: str, *, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """A progress bar with time left on a terminal, silence when piped.

    Yields a function ``update(done, total, text="")``.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda done, total, text="": None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("left"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def update(done: int, total: int, text: str = "") -> None:
            bar.update(task, completed=done, total=total, description=text or what)

        yield update
