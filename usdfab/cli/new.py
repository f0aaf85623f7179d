"""``usdfab new``: a fabric from a preset or a weave."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, print_json, say


def run(
    kind: str,
    /,
    *,
    output: Output,
    set_: Annotated[list[str] | None, Parameter(name="--set", help="NAME=VALUE, as in usdfab edit.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a new fabric from a preset or a weave.

    Usage examples:

        usdfab new denim -o denim.usda
        usdfab new "twill 2/2" -o twill.usda --set size=4mm --set both.count=12
        usdfab new 1100/0110/0011/1001 -o own.usda

    Parameters
    ----------
    kind:
        A preset (linen, denim, wool-twill, silk-satin, cotton-sateen, canvas, herringbone, taffeta, woollen-twill,
        duck), a weave (plain, "twill 3/1", "satin 5/2", "basket 2/2", ...), or a weave matrix written bottom row first
        (10/01).
    """
    from usdfab.cli.settings import parse_settings
    from usdfab.errors import UsdfabError
    from usdfab.fabric import PRESETS, FabricParameters, as_table, edited, preset, weave_from_name
    from usdfab.usd.fabric_io import write_fabric

    if kind.strip().lower() in PRESETS:
        fabric = preset(kind)
    else:
        try:
            weave = weave_from_name(kind)
        except UsdfabError as error:
            if "unknown weave" not in error.problem:
                raise
            raise UsdfabError(
                f"'{kind}' is neither a preset nor a weave",
                remedy=f"presets: {', '.join(PRESETS)}; {error.remedy.removeprefix('use ')}",
            ) from None
        fabric = replace(FabricParameters(), weave=weave)
    fabric = edited(fabric, parse_settings(set_))
    write_fabric(fabric, output, overwrite=overwrite)
    if json:
        print_json({"fabric": as_table(fabric), "output": output})
    elif not quiet:
        say(f"wrote {output}")
