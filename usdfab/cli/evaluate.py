"""``usdfab evaluate``: how good are the estimates, and what are they judged by?"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from usdfab.cli.options import Json, OptionalOutput, Overwrite, Seed, print_json, progress_bar, say
from usdfab.errors import UsdfabError


def run(
    what: Literal["photos", "fits", "losses", "raster", "ablation", "path", "network", "table2", "surface", "neural"],
    folder: Path | None = None,
    dataset: Path | None = None,
    /,
    *,
    features: str = "vgg16",
    fast: bool = False,
    count: int | None = None,
    seed: Seed = 0,
    quality: Literal["draft", "standard", "paper"] = "draft",
    ablation: bool = False,
    fibers: int | None = None,
    weave: str | None = None,
    output: OptionalOutput = None,
    overwrite: Overwrite = False,
    stages: str = "analysis,match",
    photos: Path | None = None,
    analysis: bool = True,
    json: Json = False,
) -> None:
    """Judge usdfab's estimates on labelled photos or random fabrics, or the losses of the fit, and print a table.

    Usage examples:

        usdfab evaluate photos FOLDER
        usdfab evaluate fits FOLDER -o fits --stages analysis,match --quality draft
        usdfab evaluate losses FOLDER
        usdfab evaluate raster --count 1 --fibers 40
        usdfab evaluate ablation --fibers 40 -o ablation
        usdfab evaluate path --count 3 --seed 1
        usdfab evaluate network weights.safetensors fabrics --photos FOLDER
        usdfab evaluate table2 -o table2 --stages analysis,match --quality draft
        usdfab evaluate surface -o surface --quality draft
        usdfab evaluate neural -o neural --ablation

    Parameters
    ----------
    what:
        photos: the analysis stage on real cloth. fits: how near fits come to their photos, with a picture of each; the
        same command goes on with a run that was broken off (needs the fit extra). losses: which texture statistics
        tell fabrics apart (needs the fit extra). raster, path: how well that stage recovers random fabrics of each
        weave from 20 % off (slow: a fit for each; needs the fit extra). ablation: what the raster stage finds without
        parts of its shading, its losses and its prior, as in figures 15, 17 and 18 of Li et al. 2024 (ten fits; needs
        the fit extra). network: the network's guess, alone and with the analysis, on pictures that it has not learned
        from (needs the fit extra). table2: random fabrics fitted from nothing but their picture, errors in the layout
        of Table 2 of Li et al. 2024; the same command goes on with a run that was broken off (needs the fit extra).
        surface: two surface models beside the fibers, plain, twill and satin, close up and at a distance, as in figure
        11 of that paper. neural: the neural material beside the surface model that it learned, at 1 and 3 samples and
        in equal time, in five scenes, along a zoom, and with mixed codes.
    folder:
        Of photos, fits and losses: holds the photos. For photos also SOURCES.csv with the columns file, weave and notes
        ("about N yarns across horizontally and M vertically"); for losses two or more PNG files. Of network: its
        weights, or "shipped".
    features:
        Of losses: the feature network, vgg16 or a safetensors file of another VGG.
    fast:
        Of losses: compute as the fit does, in bfloat16 where the processor has it.
    count:
        Of raster and ablation (1 by default) and of table2 (3): fabrics of each weave; of path (1): how many fabrics,
        plain, twill and satin in turn. Of neural: pixels on a side of each picture.
    quality:
        Of fits, raster, ablation, path and table2: resolution, samples and iterations, as of ``usdfab fit``; of table2
        also of the picture that is fitted: 240 pixels at 64 samples, denoised; 480 at 256; 720 at 1024. Of surface:
        and neural: pixels and samples of the pictures.
    ablation:
        Of raster: each fabric also without parts of the shading and of the losses (six fits for each). Of neural: also
        train the paper's network, on few materials, with and without its one-blob encoding and spatial fusion.
    fibers:
        Of raster and ablation: fibers in a yarn, instead of about 200, to save time.
    weave:
        Of raster: one of plain, twill0, twill1 and satin, instead of all four.
    output:
        Of ablation: a folder for its pictures (the target, then each way, side by side) and ablation.json. Of fits: a
        folder for each photo's asset, picture (photo, then each stage) and numbers. Of table2: such a folder too, with
        each true fabric and its photo. Of surface: a folder for surface.png (rows plain, twill and satin, close and
        distant; columns Irawan and Marschner 2012, Jin et al. 2022, fibers) and surface.json. Of neural: a folder for a
        picture of each scene (network, surface model with 1, with 3 and in equal time, truth), zoom.png, neural.json.
    stages:
        Of fits and table2: as of ``usdfab fit``.
    dataset:
        Of network: a folder of ``usdfab dataset fabrics``, whose test part is judged. May be left out with --photos.
    photos:
        Of network: also judge a folder of labelled photos.
    analysis:
        Of network: also analyse each picture of the data set (slow).
    """
    if output is not None and what not in ("ablation", "fits", "table2", "surface", "neural"):
        raise UsdfabError(f"evaluate {what} writes no files", place="--output", remedy="leave it out")
    if weave is not None and what != "raster":
        raise UsdfabError(f"evaluate {what} takes no weave", place="--weave", remedy="leave it out")
    if what == "network":
        _network(folder, dataset, photos, analysis, json)
        return
    if dataset is not None or photos is not None:
        raise UsdfabError(f"evaluate {what} takes no data set", place=str(dataset or photos), remedy="leave it out")
    if what in ("raster", "ablation", "path", "table2", "surface", "neural"):
        if folder is not None:
            raise UsdfabError(
                f"evaluate {what} makes its own fabrics", place=str(folder), remedy="leave the folder out"
            )
        if what == "surface":
            from usdfab.cli.evaluate_surface import surface

            surface(seed, quality, output, overwrite, json)
            return
        if what == "neural":
            from usdfab.cli.evaluate_neural import neural

            neural(seed, quality, output, overwrite, json, ablation=ablation, pixels=count)
            return
        if what == "table2":
            _table2(3 if count is None else count, seed, quality, stages, output, json)
            return
        count = 1 if count is None else count
        if what == "raster":
            _raster(count, seed, quality, ablation, fibers, weave, json)
        elif what == "ablation":
            _ablation(count, seed, quality, fibers, output, overwrite, json)
        else:
            _path(count, seed, quality, json)
        return
    if folder is None:
        raise UsdfabError(f"evaluate {what} needs a folder of photos", remedy=f"usdfab evaluate {what} FOLDER")
    if what == "losses":
        _losses(folder, features, fast, json)
    elif what == "fits":
        _fits(folder, output, stages, quality, seed, json)
    else:
        _photos(folder, json)


def _fits(folder: Path, output: Path | None, stages: str, quality: str, seed: int, json: bool) -> None:
    from dataclasses import asdict

    from usdfab.fit.fit_evaluation import evaluate_fits, format_fits

    if output is None:
        raise UsdfabError("evaluate fits needs a folder to write to", remedy="usdfab evaluate fits FOLDER -o RESULTS")
    names = [name.strip() for name in stages.split(",")]
    with progress_bar("Fits") as update:
        rows = evaluate_fits(
            folder, output, stages=names, quality=quality, seed=seed, progress=lambda text, k, n: update(k, n, text)
        )
    if json:
        print_json({"fits": [asdict(row) for row in rows]})
    else:
        print(format_fits(rows))


def _network(weights: Path | None, dataset: Path | None, photos: Path | None, analysis: bool, json: bool) -> None:
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate network")
    if weights is None or (dataset is None and photos is None):
        raise UsdfabError(
            "evaluate network needs weights, and a data set or --photos",
            remedy="usdfab evaluate network WEIGHTS DATASET --photos FOLDER",
        )
    from usdfab.fit.network.evaluation import evaluate_network
    from usdfab.fit.network.network_file import load_network
    from usdfab.fit.network.photo_evaluation import evaluate_network_photos, format_photos, photo_json
    from usdfab.fit.network.tables import format_report, summary

    network = load_network(None if str(weights) == "shipped" else weights)
    said: dict = {}
    texts = []
    if dataset is not None:
        with progress_bar("Network") as update:
            report = evaluate_network(network, dataset, analysis=analysis, progress=update)
        said["report"] = summary(report)
        texts.append(format_report(report))
    if photos is not None:
        with progress_bar("Photos") as update:
            judged = evaluate_network_photos(network, photos, progress=update)
        said["photos"] = photo_json(judged)
        texts.append(format_photos(judged))
    if json:
        print_json(said)
    else:
        print("\n\n".join(texts))


def _table2(count: int, seed: int, quality: str, stages: str, output: Path | None, json: bool) -> None:
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate table2")
    from usdfab.fit.table2_evaluation import evaluate_table2
    from usdfab.fit.table2_format import format_table2, summary

    if output is None:
        raise UsdfabError("evaluate table2 needs a folder to write to", remedy="usdfab evaluate table2 -o RESULTS")
    names = [name.strip() for name in stages.split(",")]
    with progress_bar("Table 2") as update:
        rows = evaluate_table2(
            output, stages=names, quality=quality, count=count, seed=seed,
            progress=lambda text, done, total: update(done, total, text),
        )  # fmt: skip
    if json:
        print_json(summary(rows))
    else:
        print(format_table2(rows))


def _path(count: int, seed: int, quality: Literal["draft", "standard", "paper"], json: bool) -> None:
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate path")
    from usdfab.fit.path_evaluation import PHOTO_SAMPLES, evaluate_path, format_recoveries
    from usdfab.fit.path_settings import settings_for

    # The light is known here, as it is in the paper's experiment.
    settings = settings_for(quality, gain=False)
    with progress_bar("Path stage") as update:
        results = evaluate_path(count, seed, settings, PHOTO_SAMPLES[quality], update)
    if json:
        print_json({"recoveries": [r.summary() for r in results]})
    else:
        print(format_recoveries(results))


def _raster(
    count: int, seed: int, quality: str, ablation: bool, fibers: int | None, weave: str | None, json: bool
) -> None:
    from dataclasses import asdict

    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate raster")
    from usdfab.fit.raster_evaluation import ABLATIONS, WEAVES, evaluate_raster, format_recoveries
    from usdfab.fit.raster_stage import checked_quality

    ways = tuple(ABLATIONS) if ablation else ("full",)
    if weave is not None and weave not in WEAVES:
        raise UsdfabError(f"'{weave}' is not judged", place="--weave", remedy=f"use one of {', '.join(WEAVES)}")
    with progress_bar("Raster stage") as update:
        results = evaluate_raster(
            count, seed, checked_quality(quality), weaves=WEAVES if weave is None else (weave,), ablations=ways,
            fibers=fibers, progress=update,
        )  # fmt: skip
    if json:
        print_json({"recoveries": [asdict(r) for r in results]})
    else:
        print(format_recoveries(results))


def _ablation(
    count: int, seed: int, quality: str, fibers: int | None, output: Path | None, overwrite: bool, json: bool
) -> None:
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate ablation")
    from usdfab.fit.raster_ablation import evaluate_ablation, format_ablation, planned_files, write_ablation
    from usdfab.fit.raster_stage import checked_quality

    settings = checked_quality(quality)
    paths = planned_files(output, count, overwrite=overwrite) if output else {}
    with progress_bar("Ablation") as update:
        results = evaluate_ablation(count, seed, settings, fibers=fibers, progress=update)
    if paths:
        write_ablation(results, paths, overwrite=overwrite)
        say(f"wrote {output}")
    if json:
        print_json({"results": [r.summary() for r in results]})
    else:
        print(format_ablation(results))


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
