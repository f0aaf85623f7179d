"""``usdfab merge``: the parts that ``usdfab render --tile`` wrote become one picture."""

from __future__ import annotations

from pathlib import Path

from usdfab.cli.options import Aov, Denoise, Exposure, Json, Output, Overwrite, Quiet, View, print_json, say


def run(
    *parts: Path,
    output: Output,
    aov: Aov = None,
    exposure: Exposure = None,
    view: View = None,
    denoise: Denoise = False,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Join the parts that usdfab render --tile i/n wrote into one picture, the same bit for bit as from one render.

    Usage examples:

        usdfab render cloth.usda -o cloth.exr --tile 1/2
        usdfab render cloth.usda -o cloth.exr --tile 2/2
        usdfab merge cloth.exr.*.part -o cloth.exr

    Parameters
    ----------
    parts:
        All .part files of one picture, in any order.
    """
    from usdfab.cli.picture import picture_options, render_facts, render_line, write_picture
    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES

    if not parts:
        raise UsdfabError("there is nothing to merge", remedy="give the .part files that usdfab render --tile wrote")
    options = picture_options(output, aov, denoise, exposure, view, overwrite)
    checked_output(output, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")

    from usdfab.tracer.checkpoint import load_work, merge_work
    from usdfab.tracer.render import develop

    whole = merge_work([load_work(part) for part in parts], [str(part) for part in parts])
    about = whole.identity
    size = (about.width, about.height)
    render = develop(whole.work, about.region, size, about.exposure, whole.seconds, about.segments)
    write_picture(output, render, options)
    if json:
        print_json(render_facts(output, render) | {"parts": list(parts)})
    elif not quiet:
        say(render_line(output, render))
