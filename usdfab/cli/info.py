"""``usdfab info``: what a file holds, or what this machine has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from usdfab.cli.options import Json, print_json


def run(
    file: Path | None = None,
    /,
    *,
    system: Annotated[
        bool, Parameter(negative="", help="What this machine has: LLVM, GPU, Embree, USD, memory, libraries.")
    ] = False,
    json: Json = False,
) -> None:
    """Print the fabrics of a USD file with all parameters and their units, or what usdfab finds on this machine.

    Usage examples:

        usdfab info fabric.usda
        usdfab info cloth.usda --json
        usdfab info --system

    Parameters
    ----------
    file:
        A USD file that holds at least one fabric.
    """
    from usdfab.errors import UsdfabError

    if system == (file is not None):
        problem = "--system needs no file" if system else "no file is given"
        raise UsdfabError(problem, place="info", remedy="write usdfab info FILE or usdfab info --system")
    if file is not None:
        _print_file(file, json)
        return
    from usdfab.cli.system import system_facts, system_lines

    facts = system_facts()
    if json:
        print_json(facts)
    else:
        print("\n".join(system_lines(facts)))


def _print_file(file: Path, json: bool) -> None:
    from usdfab.errors import UsdfabError
    from usdfab.fabric import as_table
    from usdfab.usd.colorways import colorways
    from usdfab.usd.fabric_io import fabric_from_prim, fabric_prims
    from usdfab.usd.stage import open_stage

    stage = open_stage(file)
    prims = fabric_prims(stage)
    if not prims:
        raise UsdfabError("no fabric in this file", place=str(file), remedy="make one with usdfab fit or usdfab new")
    fabrics = {str(prim.GetPath()): fabric_from_prim(prim) for prim in prims}
    ways = {str(prim.GetPath()): colorways(prim) for prim in prims}
    if json:
        tables = {
            path: as_table(fabric) | {"colorways": list(ways[path][0]), "colorway": ways[path][1]}
            for path, fabric in fabrics.items()
        }
        # One fabric is the usual case: its table stands at the top; several are listed by path.
        print_json(next(iter(tables.values())) if len(tables) == 1 else {"fabrics": tables})
        return
    for path, fabric in fabrics.items():
        print("\n".join(_lines(path, fabric, *ways[path])))


def _lines(path: str, fabric: Any, colorways: tuple[str, ...], selected: str) -> list[str]:
    from usdfab.fabric import YARN_PARAMETERS

    weave = fabric.weave
    ways = ", ".join(f"{name} (selected)" if name == selected else name for name in colorways)
    lines = [
        f"{path}: {fabric.name}",
        f"  weave        {weave.name} ({weave.classify()}), repeat {weave.picks} picks x {weave.ends} ends",
        *("               " + "".join("#" if v else "." for v in row) for row in weave.matrix[::-1]),
        f"  size         {fabric.size[0] * 1e3:.4g} x {fabric.size[1] * 1e3:.4g} mm",
        f"  density      {0.01 / fabric.cell[0]:.4g} ends/cm, {0.01 / fabric.cell[1]:.4g} picks/cm",
        f"  cover        warp {fabric.cover('warp'):.3g}, weft {fabric.cover('weft'):.3g}",
        f"  seed         {fabric.seed}",
        f"  variants     {fabric.variants}",
        *([f"  colourways   {ways}"] if ways else []),
        f"  {'':24}{'warp':>24}  {'weft':>24}",
    ]
    for p in YARN_PARAMETERS:
        unit = "" if p.unit == "1" else f" ({p.unit})"
        texts = [_value(getattr(fabric.system(s), p.name)) for s in ("warp", "weft")]
        lines.append(f"  {p.name + unit:28}{texts[0]:>20}  {texts[1]:>24}")
    provenance = fabric.provenance
    if provenance.source:
        lines.append(f"  from         {provenance.source} by {provenance.generator}, {', '.join(provenance.stages)}")
    return lines + [f"  note         {note}" for note in provenance.notes]


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], tuple):
            return f"{len(value)} colours"
        return " ".join(f"{v:.3g}" for v in value) if value else "-"
    return str(value) if isinstance(value, int) else f"{value:.5g}"
