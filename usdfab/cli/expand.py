"""``usdfab expand``: cloth as fibers for other programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, Resolution, parse_resolution, print_json, say

if TYPE_CHECKING:
    from usdfab.usd.expand import Expansion, Seams


def run(
    stage: Path,
    /,
    *,
    output: Output,
    mode: Annotated[
        Literal["instancer", "xform", "baked"],
        Parameter(help="Copies of pieces in a point instancer; each an Xform that also shears; or the curves bent."),
    ] = "instancer",
    fabric: Annotated[Path | None, Parameter(help="A fabric file to put on the cloth of the stage.")] = None,
    prim: Annotated[str | None, Parameter(help="Only this mesh.")] = None,
    region: Annotated[str | None, Parameter(help="Only u0,v0,u1,v1 of the mesh's texture coordinates.")] = None,
    tolerance: Annotated[
        float | None, Parameter(help="Distance of pieces from the surface before they are divided, in fiber radii.")
    ] = None,
    vertices_per_segment: Annotated[int | None, Parameter(help="Control points for each run of a yarn.")] = None,
    time: Annotated[float | None, Parameter(help="Time code at which the cloth is read.")] = None,
    purpose: Annotated[
        Literal["default", "render"],
        Parameter(help="render: fibers for final renders, the mesh stays as their proxy elsewhere."),
    ] = "default",
    max_instances: Annotated[int | None, Parameter(help="Most copies (baked: control points) to write.")] = None,
    screenshot: Annotated[Path | None, Parameter(help="Draw the place where pieces meet worst into a picture.")] = None,
    resolution: Resolution = "960x720",
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write the cloth of a stage as fibers that any USD program can draw: BasisCurves, instanced or baked.

    The new file sublayers the stage, which is not changed. Write .usdc: the arrays are large. Each tile of the fabric
    is the variant that `usdfab render` shows there. Where the cloth bends, tiles are divided into pieces down to single
    crossings of two yarns, until they meet as closely as --tolerance asks; at its borders and seams, pieces whose
    centre lies on the cloth are kept. Baked curves follow the cloth exactly and are cut where it ends.

    Usage examples:

        usdfab expand samples/drape.usda --fabric fabric.usda -o fibers.usdc
        usdfab expand samples/drape.usda --fabric fabric.usda -o fibers.usdc --mode baked --region 0.5,0.5,0.51,0.51

    Parameters
    ----------
    stage:
        A USD file with cloth meshes; those without texture coordinates are unwrapped.
    """
    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES
    from usdfab.tracer.texture_reader import TextureReader
    from usdfab.usd.expand import TOLERANCE, ExpandOptions, expand
    from usdfab.usd.fabric_io import read_fabric

    options = ExpandOptions(
        mode=mode,
        region=_region(region),
        vertices_per_segment=vertices_per_segment,
        tolerance=TOLERANCE if tolerance is None else tolerance,
        purpose=purpose,
        limit=max_instances,
    )
    width, height = parse_resolution(resolution)
    if screenshot is not None and mode == "baked":
        raise UsdfabError("baked curves have no seams to draw", place="--screenshot", remedy="use another mode")
    if screenshot is not None:
        checked_output(screenshot, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    result = expand(
        stage,
        output,
        read_fabric(fabric) if fabric is not None else None,
        options,
        prim=prim,
        time=time,
        textures=TextureReader(),
        overwrite=overwrite,
    )
    if screenshot is not None:
        from usdfab.view.expanded import screenshot_of

        screenshot_of(result, screenshot, (width, height or round(0.75 * width)), overwrite=overwrite)
    if json:
        print_json(_facts(result, screenshot))
    elif not quiet:
        for warning in result.warnings:
            say(f"warning: {warning}")
        say(_line(result))
        if screenshot is not None:
            say(f"wrote {screenshot}")


def _facts(result: Expansion, screenshot: Path | None) -> dict[str, Any]:
    """What ``--json`` says; lengths in metres. Baked curves count as prototypes of themselves."""
    return {
        "output": result.path,
        "mode": result.mode,
        "meshes": result.meshes,
        "instances": result.instances,
        "prototypes": result.prototypes,
        "prototype_curves": result.curves,
        "prototype_points": result.points,
        "bytes": result.path.stat().st_size,
        "seams": None if result.seams is None else asdict(result.seams),
        "screenshot": screenshot,
        "warnings": result.warnings,
    }


def _line(result: Expansion) -> str:
    """A sentence or two for people."""
    size = f"{result.path.stat().st_size / 1e6:.3g} MB"
    if result.mode == "baked":
        return f"wrote {result.path}: {result.curves} fibers, {result.points} control points, {size}"
    text = f"wrote {result.path}: {result.instances} copies of {result.prototypes} prototypes, {size}"
    return text if result.seams is None else f"{text}; {_seams(result.seams)}"


def _seams(seams: Seams) -> str:
    gap = f"{1e6 * seams.median:.3g} um apart in the median, {1e6 * seams.p99:.3g} um at most in 99 %"
    radii, share = seams.p99 / seams.fiber_radius, 100.0 * seams.p99 / seams.yarn_width
    return f"pieces meet {gap} ({radii:.2g} fiber radii, {share:.2g} % of a yarn's width)"


def _region(text: str | None) -> tuple[float, float, float, float] | None:
    from usdfab.errors import UsdfabError

    if text is None:
        return None
    try:
        u0, v0, u1, v1 = (float(part) for part in text.split(","))
    except ValueError:
        raise UsdfabError(
            f"'{text}' is no region", place="--region", remedy="write for example 0.4,0.4,0.6,0.6"
        ) from None
    return u0, v0, u1, v1
