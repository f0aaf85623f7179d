"""``usdfab view``: cloth in real time, to look at and to change."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Exposure, Json, Overwrite, Quiet, Resolution, Threads, parse_resolution, print_json, say


def run(
    stage: Path,
    /,
    *,
    fabric: Annotated[Path | None, Parameter(help="A fabric file to put on the cloth of the stage.")] = None,
    camera: Annotated[str | None, Parameter(help="Prim path of the camera; the stage's first by default.")] = None,
    orbit: Annotated[str, Parameter(help="Turn the camera about the cloth: degrees to the right, upwards.")] = "0,0",
    zoom: Annotated[float, Parameter(help="Go so many times nearer.")] = 1.0,
    light: Annotated[
        str | None,
        Parameter(help="AZIMUTH,ELEVATION in degrees of a sun instead of the strongest light that is no dome."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        Parameter(name="--set", negative="", help="NAME=VALUE as in usdfab edit; may be given several times."),
    ] = None,
    weave: Annotated[str | None, Parameter(help="Another weave: a name or a matrix, as in usdfab new.")] = None,
    screenshot: Annotated[Path | None, Parameter(help="Write a picture instead of opening a window.")] = None,
    spp: Annotated[int, Parameter(help="Samples per pixel of pictures that are written.")] = 4,
    exposure: Exposure = None,
    resolution: Resolution = "1280x720",
    time_code: Annotated[float | None, Parameter(help="Time code of the stage.")] = None,
    reflection_weights: Annotated[
        Path | None, Parameter(help="A file of usdfab train neural instead of the shipped network.")
    ] = None,
    transmission_weights: Annotated[Path | None, Parameter(help="The same for light from behind the cloth.")] = None,
    strict: Annotated[
        bool, Parameter(negative="", help="Stop at whatever is wrong with the stage instead of leaving it out.")
    ] = False,
    threads: Threads = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Look at cloth in real time with the neural material, and change it.

    The left button turns the camera, the middle one or Shift moves it, the wheel zooms, the right button or Ctrl moves
    the light. Sliders change the albedo of warp and weft, roughness and height scale. Keys: w another weave, s save
    a picture, r back to the first view, h hide the controls, q quit. At the end, and with every picture, it prints
    what was changed as arguments of usdfab edit.

    A stage without geometry is taken as a fabric, on its swatch.

    Usage examples:

        usdfab view samples/drape.usda --fabric fabric.usda
        usdfab view fabric.usda --screenshot swatch.png --weave "twill 2/2" --set warp.albedo=.1,.2,.5
        usdfab view cloth.usda --screenshot side.png --orbit 40,10 --zoom 2 --light 120,35

    Parameters
    ----------
    stage:
        A USD file.
    """
    from usdfab.cli.settings import parse_settings
    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES

    width, height = parse_resolution(resolution)
    size = (width, height or round(width * 9 / 16))
    turn = _pair("--orbit", orbit)
    sun = _pair("--light", light) if light is not None else None
    if not 1e-3 <= zoom <= 1e3:
        raise UsdfabError(f"{zoom} is no factor", place="--zoom", remedy="give for example 2")
    if spp < 1:
        raise UsdfabError(f"{spp} samples are none", place="--spp", remedy="give 1 or more")
    settings = parse_settings(set_)
    if weave is not None:
        settings = {"weave": weave, **settings}
    if screenshot is not None:
        checked_output(screenshot, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    else:
        from usdfab.view.gl import check_display

        check_display()

    from usdfab.cli.render_neural import load_networks
    from usdfab.cli.scene_source import SceneSource
    from usdfab.cli.view_session import ViewSession
    from usdfab.tracer.render import thread_count

    networks = load_networks({"reflection": reflection_weights, "transmission": transmission_weights}, "usdfab view")
    names = (str(stage.absolute()), str(fabric.absolute()) if fabric else None, None, camera, time_code, strict)
    session = ViewSession(SceneSource(*names), networks, thread_count(threads), exposure or 0.0)
    if not quiet:
        for warning in session.warnings:
            say(f"warning: {warning}")
    session.turn(*turn)
    session.zoom(zoom)
    session.change(settings)
    if sun is not None:
        session.light(*sun)
    if screenshot is None:
        session.window(size, stage.with_suffix(".view.png").name, spp, quiet=quiet)
    else:
        seconds = session.save(screenshot, size, spp, overwrite=overwrite)
        if not (quiet or json):
            say(f"wrote {screenshot}: {size[0]} x {size[1]}, {spp} spp, {seconds:.2f} s")
    arguments = session.live.edit_arguments()
    if json:
        said = {"output": screenshot, "edit": arguments, "warnings": session.warnings}
        print_json(said)
    elif arguments and not quiet:
        say(session.edit_line(fabric or stage))


def _pair(option: str, text: str) -> tuple[float, float]:
    """Two finite numbers of ``A,B``."""
    from usdfab.errors import UsdfabError

    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsdfabError(f"'{text}' is not two numbers", place=option, remedy="write for example 30,45") from error
    if not abs(first) + abs(second) < 1e6:
        raise UsdfabError(f"'{text}' is not two angles in degrees", place=option, remedy="write for example 30,45")
    return first, second
