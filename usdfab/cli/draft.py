"""``usdfab draft``: weavers' drafts of fabrics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, OptionalOutput, Overwrite, Quiet, print_json, say


def run(
    file: Path,
    /,
    *,
    output: OptionalOutput = None,
    screenshot: Annotated[Path | None, Parameter(help="Write the drawdown as a picture.")] = None,
    prim: Annotated[str | None, Parameter(help="Material path, where the file holds several fabrics.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a fabric as a weavers' draft (WIF 1.1), draw its drawdown, or say what loom it needs.

    A WIF holds the weave, colours, spacing and thickness of one repeat. The picture shows each crossing in the colour
    of the yarn on top, with the threading above and the treadling to the right; end 1 is at the left, pick 1 at the
    bottom.

    Usage examples:

        usdfab draft fabric.usda -o fabric.wif --screenshot drawdown.png
        usdfab draft draft.wif --screenshot drawdown.png

    Parameters
    ----------
    file:
        A USD file that holds a fabric, or a draft (.wif).
    """
    from usdfab.fabric import FabricParameters, read_wif, with_draft, write_wif
    from usdfab.fabric.draft import loom_of
    from usdfab.fabric.draft_picture import draft_picture
    from usdfab.fabric.wif import WIF_SUFFIXES
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES, write_image

    warnings: tuple[str, ...] = ()
    if file.suffix.lower() in WIF_SUFFIXES:
        draft = read_wif(file)
        fabric, warnings = with_draft(FabricParameters(), draft), draft.warnings
    else:
        from usdfab.usd.fabric_io import read_fabric

        fabric = read_fabric(file, prim)
    # Both are refused before either is written.
    if output is not None:
        checked_output(output, WIF_SUFFIXES, overwrite=overwrite, kind="drafts")
    if screenshot is not None:
        checked_output(screenshot, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
        picture = draft_picture(fabric)
    if output is not None:
        write_wif(output, fabric, overwrite=overwrite)
    if screenshot is not None:
        write_image(screenshot, picture, overwrite=overwrite)
    picks, ends = fabric.repeat()
    loom = loom_of(fabric.weave.matrix)
    colors = {s: len(set(fabric.system(s).colors())) for s in ("warp", "weft")}
    if json:
        print_json(
            {
                "name": fabric.name,
                "picks": picks,
                "ends": ends,
                "shafts": loom.shafts,
                "treadles": loom.treadles,
                "ends_per_cm": 0.01 / fabric.cell[0],
                "picks_per_cm": 0.01 / fabric.cell[1],
                "colors": colors,
                "output": output,
                "screenshot": screenshot,
                "warnings": list(warnings),
            }
        )
        return
    if not quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        for written in (output, screenshot):
            if written is not None:
                say(f"wrote {written}")
    print(
        f"{fabric.name}: {picks} picks x {ends} ends, {loom.shafts} shafts, {loom.treadles} treadles, "
        f"{colors['warp']} + {colors['weft']} colours, {0.01 / fabric.cell[0]:.3g} ends/cm, "
        f"{0.01 / fabric.cell[1]:.3g} picks/cm"
    )
