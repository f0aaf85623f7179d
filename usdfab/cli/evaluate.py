"""``usdfab evaluate``: how good are the estimates, and what are they judged by?"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from usdfab.cli.options import Json, print_json, progress_bar


def run(
    what: Literal["photos", "losses"],
    folder: Path,
    /,
    *,
    features: str = "vgg16",
    fast: bool = False,
    json: Json = False,
) -> None:
    """Judge usdfab's estimates on labelled photos, or the losses of the fit on any photos, and print a table.

    Usage examples:

        usdfab evaluate photos FOLDER
        usdfab evaluate losses FOLDER

    Parameters
    ----------
    what:
        photos: the analysis stage on real cloth. losses: which texture statistics tell fabrics apart (needs the fit
        extra).
    folder:
        Holds the photos. For photos also SOURCES.csv with the columns file, weave and notes ("about N yarns across
        horizontally and M vertically"); for losses two or more PNG files.
    features:
        Of losses: the feature network, vgg16 or a safetensors file of another VGG.
    fast:
        Of losses: compute as the fit does, in bfloat16 where the processor has it.
    """
    if what == "losses":
        _losses(folder, features, fast, json)
    else:
        _photos(folder, json)


def _losses(folder: Path, features: str, fast: bool, json: bool) -> None:
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate losses")
    from usdfab.fit.features import fast_dtype, load_features
    from usdfab.fit.loss_evaluation import evaluate_losses, format_losses

    net = load_features(features, dtype=fast_dtype()) if fast else load_features(features)
    with progress_bar("Losses") as update:
        results = evaluate_losses(folder, net, progress=update)
    if json:
        print_json({"losses": [r.summary() for r in results]})
    else:
        print(format_losses(results))


def _photos(folder: Path, json: bool) -> None:
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
