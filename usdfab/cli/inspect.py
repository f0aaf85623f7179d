"""``usdfab inspect``: look at fibers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from usdfab.cli.options import Overwrite, Quiet, Resolution, parse_resolution, say


def run(
    file: Path,
    /,
    *,
    screenshot: Annotated[Path | None, Parameter(help="Write a picture instead of opening a window.")] = None,
    tiles: Annotated[str, Parameter(help="Copies of the patch, COLUMNSxROWS.")] = "2x2",
    color: Annotated[Literal["yarn", "fiber", "height", "albedo"], Parameter(help="What the colour shows.")] = "yarn",
    prim: Annotated[str | None, Parameter(help="Material path, where the file holds several fabrics.")] = None,
    background: Literal["white", "dark"] = "white",
    resolution: Resolution = "1280x960",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Show the fibers of a fabric as tubes, in a turning window or as a picture.

    Usage examples:

        usdfab inspect fabric.usda
        usdfab inspect fabric.usda --screenshot fibers.png --color albedo --tiles 1x1

    Parameters
    ----------
    file:
        A USD file that holds a fabric.
    """
    from usdfab.errors import UsdfabError
    from usdfab.fibers import generate_patch
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES
    from usdfab.usd.fabric_io import read_fabric
    from usdfab.view import inspect as view

    try:
        counts = tuple(int(part) for part in tiles.lower().split("x"))
    except ValueError:
        counts = ()
    if len(counts) != 2 or min(counts) < 1:
        raise UsdfabError(f"'{tiles}' is no number of tiles", place="--tiles", remedy="write for example 2x2")
    width, height = parse_resolution(resolution)
    size = (width, height or round(0.75 * width))
    if screenshot is not None:
        checked_output(screenshot, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    patch = generate_patch(read_fabric(file, prim))
    if screenshot is None:
        view.show(patch, color=color, tiles=counts, background=background)
        return
    view.screenshot(
        screenshot, patch, color=color, tiles=counts, resolution=size, background=background, overwrite=overwrite
    )
    if not quiet:
        say(f"wrote {screenshot}")
