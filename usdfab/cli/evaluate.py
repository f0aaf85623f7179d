"""``usdfab evaluate``: how good are the estimates?"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from usdfab.cli.options import Json, print_json


def run(what: Literal["photos"], folder: Path, /, *, json: Json = False) -> None:
    """Judge usdfab's estimates on labelled photos and print a table.

    Usage examples:

        usdfab evaluate photos FOLDER

    Parameters
    ----------
    what:
        photos: the analysis stage on real cloth.
    folder:
        Holds the photos and SOURCES.csv with the columns file, weave and notes ("about N yarns across horizontally and
        M vertically").
    """
    from usdfab.fit.evaluation import evaluate_photos, format_rows, totals

    rows = evaluate_photos(folder)
    if not json:
        print(format_rows(rows))
        return
    classes, counts, labelled = totals(rows)
    photos = [
        {
            "file": row.file,
            "weave": row.weave,
            "weave_estimate": row.analysis.weave_class if row.analysis else None,
            "warp_count": row.warp_count,
            "weft_count": row.weft_count,
            "warp_count_estimate": row.analysis.warp_count if row.analysis else None,
            "weft_count_estimate": row.analysis.weft_count if row.analysis else None,
            "problem": row.problem,
            "seconds": row.seconds,
        }
        for row in rows
    ]
    summary = {"classes_right": classes, "photos": len(rows), "counts_right": counts, "counts": labelled}
    print_json({"summary": summary, "rows": photos})
