"""``usdfab edit``: change a fabric, mix two, or give one several colourways."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, print_json, say

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters


def run(
    fabric: Path | None = None,
    /,
    *,
    output: Output,
    set_: Annotated[
        list[str] | None, Parameter(name="--set", negative="", help="NAME=VALUE; may be given several times.")
    ] = None,
    weave: Annotated[str | None, Parameter(help="Another weave: a name or a matrix, as in usdfab new.")] = None,
    wif: Annotated[Path | None, Parameter(help="Weave, colours, spacing and thickness of a weavers' draft.")] = None,
    recolor: Annotated[
        list[str] | None,
        Parameter(
            negative="", help="warp=#204080, weft=.1,.2,.5, both=..., '#aa3322->#224488'; may be given several times."
        ),
    ] = None,
    mix: Annotated[
        tuple[Path, Path, float] | None,
        Parameter(negative="", help="Two fabrics and a number: 0 is the first, 1 the second."),
    ] = None,
    colorway: Annotated[
        str | None, Parameter(help="Put the new colours into this colourway of the file, and select it.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Change a fabric and write the result as a new file.

    All else in the file stays as it is. Changes are made in the order --mix, --wif, --weave, --set, --recolor.

    Names for --set are weave, size, seed, variants, name, and warp., weft. or both. followed by a parameter: count,
    radius, flattening, fiber_count, fiber_radius, packing, inclination, crimp, twist, ply_count, ply_twist,
    irregularity, migration, migration_rate, flyaway_density, flyaway_loop_fraction, flyaway_length, flyaway_spread,
    albedo, yarn_albedo, roughness_longitudinal, roughness_azimuthal, roughness_primary, ior, cuticle_tilt.

    Colours for --recolor are #rrggbb (sRGB) or three linear numbers. WARP=COLOR dyes all yarns of a system, stripes
    included; OLD->NEW dyes the yarns that have a colour, warp:OLD->NEW only among the warp. Quote # and > in a shell.

    --mix mixes lengths and numbers by their logarithms, all else linearly, colours as light; weave, plies, seed and
    name are the nearer fabric's.

    --colorway makes a variant set of the Material, which every USD program can switch: the first colourway, original,
    keeps the colours from before. --colorway NAME alone selects one that exists.

    Usage examples:

        usdfab edit fabric.usda --set warp.albedo=.1,.2,.5 -o blue.usda
        usdfab edit fabric.usda --weave "twill 2/2" --set both.radius=120um -o twill.usda
        usdfab edit fabric.usda --wif samples/shepherd-check.wif -o check.usda
        usdfab edit fabric.usda --colorway navy --recolor "warp=#102040" -o colorways.usda
        usdfab edit --mix linen.usda denim.usda 0.3 -o between.usda

    Parameters
    ----------
    fabric:
        A USD file that holds one fabric; left out with --mix.
    """
    from usdfab.cli.settings import parse_settings, woven_by
    from usdfab.errors import UsdfabError
    from usdfab.fabric import as_table, edited, mixed, recolored
    from usdfab.usd.edit import change_fabric
    from usdfab.usd.fabric_io import read_fabric, read_meters_per_uv, write_fabric

    if (fabric is None) == (mix is None):
        raise UsdfabError("one fabric or --mix is needed" if fabric is None else "--mix names both of its fabrics")
    if not (set_ or weave or wif or recolor or mix or colorway):
        raise UsdfabError("nothing to change", remedy="give --set, --weave, --wif, --recolor, --mix or --colorway")
    if mix is not None and colorway is not None:
        raise UsdfabError("does not go with --mix", place="--colorway", remedy="add the colourway to the mixed fabric")
    settings = parse_settings(set_)
    warnings: list[str] = []

    def change(before: FabricParameters) -> FabricParameters:
        after = before
        if wif is not None:
            after, told = woven_by(after, wif)
            warnings.extend(told)
        if weave is not None:
            after = edited(after, {"weave": weave})
        return recolored(edited(after, settings), recolor or ())

    if mix is not None:
        first, second, amount = mix
        result = change(mixed(read_fabric(first), read_fabric(second), amount))
        meters = read_meters_per_uv(first if amount <= 0.5 else second)
        write_fabric(result, output, meters_per_uv=meters, overwrite=overwrite)
    else:
        changes = bool(set_ or weave or wif or recolor)
        change_fabric(str(fabric), change if changes else None, output, colorway=colorway or "", overwrite=overwrite)
    if json:
        print_json({"fabric": as_table(read_fabric(output)), "output": output, "warnings": warnings})
    elif not quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        say(f"wrote {output}")
