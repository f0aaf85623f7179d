"""``usdfab new``: a fabric from a preset, a weave, or a weavers' draft."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, print_json, say

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters


def run(
    kind: str | None = None,
    /,
    *,
    output: Output,
    wif: Annotated[Path | None, Parameter(help="A weavers' draft (.wif): weave, colours, spacing, thickness.")] = None,
    set_: Annotated[
        list[str] | None, Parameter(name="--set", negative="", help="NAME=VALUE, as in usdfab edit.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a new fabric from a preset, a weave, or a weavers' draft.

    With --wif the preset or weave, if given, says what a draft does not: fibers, twist, crimp, and spacing where the
    draft has none. The sample shows whole repeats of the draft.

    Usage examples:

        usdfab new denim -o denim.usda
        usdfab new "twill 2/2" -o twill.usda --set size=4mm --set both.count=12
        usdfab new 1100/0110/0011/1001 -o own.usda
        usdfab new --wif samples/shepherd-check.wif -o check.usda
        usdfab new wool-twill --wif samples/shepherd-check.wif -o wool-check.usda

    Parameters
    ----------
    kind:
        A preset (linen, denim, wool-twill, silk-satin, cotton-sateen, canvas, herringbone, taffeta, woollen-twill,
        duck), a weave (plain, "twill 3/1", "satin 5/2", "basket 2/2", ...), or a weave matrix written bottom row first
        (10/01).
    """
    from usdfab.cli.settings import parse_settings, woven_by
    from usdfab.errors import UsdfabError
    from usdfab.fabric import FabricParameters, as_table, edited
    from usdfab.usd.fabric_io import write_fabric

    if kind is None and wif is None:
        raise UsdfabError("a preset, a weave or --wif is needed", remedy="e.g. usdfab new denim -o denim.usda")
    fabric = _fabric(kind) if kind is not None else FabricParameters()
    warnings: tuple[str, ...] = ()
    if wif is not None:
        fabric, warnings = woven_by(fabric, wif)
    fabric = edited(fabric, parse_settings(set_))
    write_fabric(fabric, output, overwrite=overwrite)
    if json:
        print_json({"fabric": as_table(fabric), "output": output, "warnings": list(warnings)})
    elif not quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        say(f"wrote {output}")


def _fabric(kind: str) -> FabricParameters:
    from usdfab.errors import UsdfabError
    from usdfab.fabric import PRESETS, FabricParameters, preset, weave_from_name

    if kind.strip().lower() in PRESETS:
        return preset(kind)
    try:
        weave = weave_from_name(kind)
    except UsdfabError as error:
        if "unknown weave" not in error.problem:
            raise
        raise UsdfabError(
            f"'{kind}' is neither a preset nor a weave",
            remedy=f"presets: {', '.join(PRESETS)}; {error.remedy.removeprefix('use ')}",
        ) from None
    return replace(FabricParameters(), weave=weave)
