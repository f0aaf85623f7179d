"""Options and habits that the commands share."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
