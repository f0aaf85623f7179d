"""``usdfab fit``: from a photo to a fabric."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from usdfab.cli.options import (
    Denoise,
    Json,
    Output,
    Overwrite,
    Quiet,
    Seed,
    parse_region,
    print_json,
    progress_bar,
    say,
)

if TYPE_CHECKING:
    from usdfab.fit.pipeline import Fit


def run(
    photo: Path,
    /,
    *,
    output: Output,
    size: Annotated[
        str | None, Parameter(help="Physical width of the whole picture, also where it is cropped, e.g. 3.6mm.")
    ] = None,
    pixel_size: Annotated[str | None, Parameter(help="Physical size of a pixel, e.g. 7.5um.")] = None,
    crop: Annotated[
        str | None,
        Parameter(help="Use only X0,Y0,X1,Y1 of the picture: pixels from the top left, or e.g. 25%,25%,75%,75%."),
    ] = None,
    weave: Annotated[
        str | None,
        Parameter(
            help="The weave, where you know it, warp upright: plain, 'twill 2/1', 'satin 8/3', rows such as "
            "1100/0110/0011/1001 (bottom row first, 1: weft on top), ... A direction that you do not say is found."
        ),
    ] = None,
    yarns: Annotated[
        str | None,
        Parameter(
            help="Ends across and picks down the picture, where you have counted them, e.g. 12x9; about is enough."
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        Parameter(
            help="Rig stage of the photo: its camera, looking straight down, and its lights; else both are found."
        ),
    ] = None,
    save_rig: Annotated[
        Path | None, Parameter(help="Write the rig that was found, for `usdfab render FABRIC --rig` (new .usda file).")
    ] = None,
    stages: Annotated[
        str,
        Parameter(
            help="Comma-separated: analysis, network, raster, match, path; all but the first need the fit extra."
        ),
    ] = "analysis",
    quality: Annotated[
        Literal["draft", "standard", "paper"],
        Parameter(help="Resolution, samples and iterations of the stages after the analysis."),
    ] = "draft",
    resume: Annotated[
        bool, Parameter(negative="", help="Go on from what an unfinished fit left beside OUTPUT.")
    ] = False,
    force: Annotated[
        bool, Parameter(negative="", help="Go on where no woven fabric is found in the photo, with a warning.")
    ] = False,
    report: Annotated[Path | None, Parameter(help="Folder for a page, report.html, and its pictures.")] = None,
    report_spp: Annotated[int, Parameter(help="Samples per pixel of the report's pictures.")] = 24,
    denoise: Denoise = False,
    seed: Seed = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Estimate a fabric from one photo of woven cloth, seen straight from above.

    The analysis stage reads counts, weave, colours, widths and twist from the photo; fiber parameters it cannot see
    are priors, and what is uncertain is said. The network stage weighs counts, weave and widths with its own guess.
    The raster stage then moves shape and appearance until a rasterized picture resembles the photo, the match stage
    shape, appearance, exposure and lamp until a path-traced one does, the path stage colours and roughnesses by
    gradients of the path tracer; each of these three is slow, and is used only where it comes closer. Ctrl-C ends
    them early with the best so far. What is finished is kept beside OUTPUT until the fit is done; after a break
    --resume goes on from there, to the same result. A photo that shows no woven fabric ends with exit code 3 and
    what was measured; nothing is written then, unless --force is given.

    Usage examples:

        usdfab fit photo.png -o fabric.usda --size 3.6mm
        usdfab fit photo.tif -o fabric.usda --pixel-size 7.5um --report report --json
        usdfab fit photo.png -o fabric.usda --size 3.6mm --crop 100,100,900,700
        usdfab fit photo.png -o fabric.usda --size 3.6mm --weave 'twill 2/2' --yarns 12x11
        usdfab fit photo.png -o fabric.usda --size 3.6mm --stages analysis,match --quality standard
        usdfab fit photo.png -o fabric.usda --rig microscope.usda --stages analysis,match
        usdfab fit photo.png -o fabric.usda --size 3.6mm --stages analysis,raster,path --quality standard --resume

    Parameters
    ----------
    photo:
        PNG, JPEG, TIFF or EXR; yarns roughly along the picture's sides.
    """
    from usdfab.errors import UsdfabError
    from usdfab.fabric import as_table, parse_length
    from usdfab.files import checked_output
    from usdfab.fit.analysis.known import Known, known_counts, known_weaves
    from usdfab.fit.fit_checkpoint import CheckpointFiles
    from usdfab.fit.pipeline import fit_photo
    from usdfab.fit.report import PAGE, check_report_folder, write_report
    from usdfab.imaging import check_denoiser
    from usdfab.usd.atomic import USD_SUFFIXES
    from usdfab.usd.fabric_io import write_fabric
    from usdfab.usd.rig import rig_for, write_rig

    checked_output(output, USD_SUFFIXES, overwrite=overwrite)
    if save_rig is not None:
        checked_output(save_rig, USD_SUFFIXES, overwrite=overwrite)
        if rig is not None:
            raise UsdfabError("the rig is given: there is none to save", place="--save-rig", remedy="leave one out")
    given_rig = None
    if rig is not None:
        from usdfab.usd.read_rig import read_rig

        given_rig = read_rig(rig)
    if report is not None:
        check_report_folder(report, overwrite=overwrite)
    if denoise:
        check_denoiser()
    if not 0 <= seed < 2**31:
        raise UsdfabError(f"{seed} is not between 0 and 2^31 - 1", place="--seed")
    width = parse_length(size) if size else None
    pixel = parse_length(pixel_size) if pixel_size else None
    region = parse_region(crop, "--crop")
    known = Known(known_weaves(weave) if weave else (), known_counts(yarns) if yarns else None)
    files = CheckpointFiles(output)
    left = files.existing()
    if left and not (resume or overwrite):
        raise UsdfabError(
            "an unfinished fit is there",
            place=str(left[0]),
            remedy="go on with --resume or start anew with --overwrite",
        )
    with progress_bar("fitting", quiet=quiet) as update:
        fit = fit_photo(
            photo,
            width,
            pixel,
            seed,
            lambda text, done, total: update(done, total, text),
            stages=[name.strip() for name in stages.split(",")],
            quality=quality,
            crop=region.pixels if region else None,
            checkpoint=files,
            resume=resume,
            force=force,
            rig=given_rig,
            known=known,
        )
    write_fabric(fit.fabric, output, overwrite=overwrite)
    if save_rig is not None:
        write_rig(save_rig, fit.fabric.size, rig=fit.rig or rig_for(fit.fabric.size), overwrite=overwrite)
    stopped = next((stage.name for stage in fit.stages if stage.interrupted), None)
    if stopped is None:
        files.remove()
    elif not quiet:
        say(f"the {stopped} stage was interrupted: the same command with --resume --overwrite goes on from there")
    pictures: dict[str, Path] = {}
    if report is not None:
        with progress_bar("rendering the report", quiet=quiet) as update:
            pictures = write_report(
                fit, report, spp=report_spp, seed=seed, denoised=denoise, overwrite=overwrite, asset=output,
                progress=update,
            )  # fmt: skip
    if not quiet:
        for warning in fit.warnings:
            say(f"warning: {warning}")
    if json:
        print_json(
            {
                "output": output,
                "fabric": as_table(fit.fabric),
                "analysis": _analysis(fit),
                "exposure": fit.exposure,
                "rig": None if fit.rig is None or given_rig is not None else asdict(fit.rig),
                "stages": _stages(fit),
                "pictures": {name: path for name, path in pictures.items() if name != PAGE},
                "report": pictures.get(PAGE),
            }
        )
    elif not quiet:
        fabric = fit.fabric
        say(
            f"wrote {output}: {fabric.weave.classify()} weave, {fabric.weave.picks} x {fabric.weave.ends} repeat, "
            f"{0.01 / fabric.cell[0]:.1f} ends/cm, {0.01 / fabric.cell[1]:.1f} picks/cm"
        )
        for path in pictures.values():
            say(f"wrote {path}")


def _stages(fit: Fit) -> list[dict[str, Any]]:
    from usdfab.fabric import as_table

    return [
        {
            "name": stage.name,
            "seconds": stage.seconds,
            # JSON knows no NaN: a step taken back has no loss.
            "losses": [loss if math.isfinite(loss) else None for loss in stage.losses],
            "distance": stage.distance,
            "notes": list(stage.notes),
            "interrupted": stage.interrupted,
            "uncertainty": dict(stage.uncertainty),
            "parameters": {name: as_table(stage.fabric)[name] for name in ("warp", "weft")},
        }
        for stage in fit.stages
    ]


def _analysis(fit: Fit) -> dict[str, Any]:
    seen = fit.analysis
    result: dict[str, Any] = {
        "weave_class": seen.weave_class,
        "weave_matrix": seen.weave.matrix.astype(int).tolist(),
        "weave_confidence": seen.weave_confidence,
        "lattice_confidence": seen.lattice_confidence,
        "rotation_rad": seen.rotation,
        "rotation_confidence": seen.rotation_confidence,
        "gap_cover": seen.gap_cover,
        "gap_confidence": seen.gap_confidence,
        "size_source": fit.size_source,
        "doubts": [doubt.as_table() for doubt in fit.doubts],
        "warnings": list(fit.warnings),
    }
    for name, system in (("warp", seen.warp), ("weft", seen.weft)):
        result[name] = {
            "count": system.count,
            "count_confidence": system.count_confidence,
            "width": system.width,
            "width_confidence": system.width_confidence,
            "colour": system.colour.tolist(),
            "colour_confidence": system.colour_confidence,
            "twist": system.twist,
            "fiber_angle_rad": system.fiber_angle,
            "twist_confidence": system.twist_confidence,
        }
    return result
