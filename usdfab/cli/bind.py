"""``usdfab bind``: put a fabric on the cloth of a stage."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, Resolution, parse_resolution, print_json, say

if TYPE_CHECKING:
    from usdfab.usd.bind import Bound
    from usdfab.usd.scene import Scene
    from usdfab.usd.stretch import Spread, Surface


def run(
    stage: Path,
    fabric: Path,
    /,
    *,
    output: Output,
    prim: Annotated[
        list[str] | None,
        Parameter(negative="", help="Mesh, subset of faces, or what holds meshes; may be given several times."),
    ] = None,
    collection: Annotated[
        list[str] | None, Parameter(negative="", help="PATH.collection:NAME; may be given several times.")
    ] = None,
    all_: Annotated[bool, Parameter(name="--all", negative="", help="Bind every mesh that looks like cloth.")] = False,
    material: Annotated[str | None, Parameter(help="Material path, where the fabric file holds several.")] = None,
    variant: Annotated[
        list[str] | None, Parameter(negative="", help="SET=NAME of the fabric, e.g. a colourway; several times.")
    ] = None,
    rotate: Annotated[float | None, Parameter(help="Turn the fabric by so many degrees, from u towards v.")] = None,
    scale: Annotated[float | None, Parameter(help="Yarns so many times larger than life.")] = None,
    meters_per_uv: Annotated[
        str | None, Parameter(help="Length of cloth in one unit of uv, e.g. 30cm; measured if not given.")
    ] = None,
    stronger: Annotated[bool, Parameter(negative="", help="Win against bindings further down.")] = False,
    screenshot: Annotated[Path | None, Parameter(help="Draw the stretch into a picture.")] = None,
    resolution: Resolution = "1280x960",
    stretch_limit: Annotated[float, Parameter(help="Warn of surface that is stretched by more than this.")] = 1.25,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Put a fabric on the cloth of a stage, by a new layer over it that holds nothing but the binding.

    The stage is not changed: the new file sublayers it and references the fabric, both by relative paths. Without
    --prim and --collection the only mesh that looks like cloth is bound. Reports yarns per centimetre on the surface
    and how much the texture coordinates stretch the cloth.

    Usage examples:

        usdfab bind samples/drape.usda fabric.usda -o bound.usda --screenshot stretch.png
        usdfab bind shot.usd fabric.usda -o bound.usda --prim /World/Sofa/Seat --rotate 90
        usdfab bind shot.usd fabric.usda -o bound.usda --collection /World.collection:cloth

    Parameters
    ----------
    stage:
        A USD file with meshes.
    fabric:
        A USD file that holds a fabric.
    """
    from usdfab.errors import UsdfabError
    from usdfab.fabric.fabric import parse_length
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES
    from usdfab.usd.bind import bind

    if not stretch_limit >= 1.0:
        raise UsdfabError(f"{stretch_limit:g} is not 1 or more", place="--stretch-limit")
    width, height = parse_resolution(resolution)
    if screenshot is not None:
        checked_output(screenshot, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    bound = bind(
        stage,
        fabric,
        output,
        prims=prim or (),
        collections=collection or (),
        every=all_,
        material=material,
        variants=_selections(variant or []),
        rotate=rotate,
        scale=scale,
        meters_per_uv=None if meters_per_uv is None else parse_length(meters_per_uv),
        stronger=stronger,
        overwrite=overwrite,
    )
    scene, found, warnings = _measured(bound, stretch_limit, scale or 1.0)
    if screenshot is not None and scene is not None and found:
        from usdfab.view import stretch as view

        size = (width, height or round(0.75 * width))
        view.screenshot(
            screenshot, found, limit=stretch_limit, up_axis=scene.up_axis, resolution=size, overwrite=overwrite
        )
    elif screenshot is not None:
        warnings.append(f"{screenshot}: there is no surface to draw")
    warnings = [*bound.warnings, *warnings]
    if json:
        print_json(_facts(bound, found, warnings, screenshot if found else None))
        return
    for surface in found:
        print("\n".join(_lines(surface)))
    if not quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        say(f"wrote {output}: {bound.material} on {', '.join(bound.targets)}")


def _selections(texts: list[str]) -> dict[str, str]:
    from usdfab.errors import UsdfabError

    pairs = [text.partition("=") for text in texts]
    for text, (name, _, chosen) in zip(texts, pairs, strict=True):
        if not name or not chosen:
            raise UsdfabError(f"'{text}' is no selection", place="--variant", remedy="write for example look=navy")
    return {name: chosen for name, _, chosen in pairs}


def _measured(bound: Bound, limit: float, scale: float) -> tuple[Scene | None, list[Surface], list[str]]:
    """The bound stage, its surfaces with the fabric, and warnings; a stage that cannot be drawn is one of them."""
    from usdfab.errors import UsdfabError
    from usdfab.usd.read_scene import read_scene
    from usdfab.usd.stretch import surfaces, warnings

    try:
        scene = read_scene(bound.path, shutter=False)
    except UsdfabError as error:
        return None, [], [f"the stretch cannot be measured: {error}"]
    found = surfaces(scene, limit, (bound.material,), scale)
    # What concerns other prims of the stage is told when it is rendered.
    said = [text for text in scene.warnings if any(path in text for path in (*bound.meshes, bound.material))]
    if not found:
        said.append("no mesh that is drawn wears the fabric")
    return scene, found, said + [text for surface in found for text in warnings(surface.report)]


def _facts(bound: Bound, found: list[Surface], warnings: list[str], picture: Path | None) -> dict[str, Any]:
    return {
        "output": bound.path,
        "material": bound.material,
        "targets": list(bound.targets),
        "surfaces": [surface.report.as_table() for surface in found],
        "screenshot": picture,
        "warnings": warnings,
    }


def _lines(surface: Surface) -> list[str]:
    report = surface.report
    return [
        f"{report.mesh}: {report.area * 1e4:.4g} cm^2",
        f"  ends/cm      {_spread(report.ends_per_cm)}, flat {report.nominal_ends_per_cm:.4g}",
        f"  picks/cm     {_spread(report.picks_per_cm)}, flat {report.nominal_picks_per_cm:.4g}",
        f"  most drawn   {_spread(report.stretch_max)}",
        f"  least drawn  {_spread(report.stretch_min)}",
        f"  shear        {_spread(report.shear_degrees)} degrees",
        f"  one uv unit  {report.meters_per_uv * 1e3:.4g} mm of cloth",
    ]


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return "-"
    middle, whole = f"{spread.p5:.4g} to {spread.p95:.4g}", f"{spread.min:.4g} to {spread.max:.4g}"
    return f"{spread.mean:.4g} (90 % from {middle}, all from {whole})"
