"""``usdfab evaluate surface``: surface models beside the fibers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from usdfab.cli.options import print_json, progress_bar, say
from usdfab.errors import UsdfabError


def surface(seed: int, quality: str, output: Path | None, overwrite: bool, json: bool) -> None:
    """Render, compare, write a picture and numbers, print the table."""
    from usdfab.neural.surface_comparison import (
        SCALES,
        compare_surfaces,
        format_comparison,
        planned_files,
        summary,
        write_comparison,
    )

    if output is None:
        raise UsdfabError("evaluate surface needs a folder to write to", remedy="usdfab evaluate surface -o RESULTS")
    paths = planned_files(output, overwrite=overwrite)
    scale = replace(SCALES[quality], seed=seed)
    with progress_bar("Surface models") as update:
        result = compare_surfaces(scale, lambda done, total, text: update(done, total, text))
    write_comparison(result, scale, paths, overwrite=overwrite)
    say(f"wrote {paths[0]} and {paths[1]}")
    if json:
        print_json(summary(result, scale))
    else:
        print(format_comparison(result))
