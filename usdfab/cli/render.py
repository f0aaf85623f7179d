"""``usdfab render``: a swatch of a fabric, or a stage whose meshes wear fabrics."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from usdfab.cli.options import (
    Aov,
    Denoise,
    Exposure,
    Json,
    OptionalOutput,
    Overwrite,
    Quiet,
    Resolution,
    Seed,
    Threads,
    View,
    frame_path,
    parse_region,
    parse_resolution,
    parse_tile,
    print_json,
)


def run(
    stage: Path,
    /,
    *,
    output: OptionalOutput = None,
    fabric: Annotated[Path | None, Parameter(help="A fabric file to put on the cloth of the stage.")] = None,
    rig: Annotated[Path | None, Parameter(help="Capture-rig stage for a swatch: camera, light, plane.")] = None,
    camera: Annotated[str | None, Parameter(help="Prim path of the camera; the stage's first by default.")] = None,
    resolution: Resolution = "640",
    region: Annotated[
        str | None, Parameter(help="Only x0,y0,x1,y1 of the picture, in pixels or percent (25%).")
    ] = None,
    spp: Annotated[
        int | None,
        Parameter(help="Samples per pixel, 32 by default; with --noise, the most. 1 with --backend neural."),
    ] = None,
    time: Annotated[float | None, Parameter(help="Seconds after which to stop, if spp are not reached.")] = None,
    noise: Annotated[
        float | None, Parameter(help="Relative error to reach, e.g. 0.05; each tile stops when it is there.")
    ] = None,
    max_depth: Annotated[int, Parameter(help="Longest path; 2 is direct light only.")] = 64,
    time_code: Annotated[float | None, Parameter(help="Time code of the stage to render.")] = None,
    frames: Annotated[
        str | None, Parameter(help="Time codes 1-10, 1-10x2, 1,5,9 or all; one file each: out.####.exr.")
    ] = None,
    aov: Aov = None,
    exposure: Exposure = None,
    view: View = None,
    denoise: Denoise = False,
    checkpoint: Annotated[
        Path | None, Parameter(help="File for the unfinished render; OUTPUT.partial by default.")
    ] = None,
    resume: Annotated[
        bool, Parameter(negative="", help="Go on with an unfinished render; skip finished frames.")
    ] = False,
    tile: Annotated[
        str | None, Parameter(help="Only part i/n, into OUTPUT.iofn.part; usdfab merge joins the parts.")
    ] = None,
    workers: Annotated[int | None, Parameter(help="Render in this many processes (needs the cluster extra).")] = None,
    scheduler: Annotated[
        str | None, Parameter(help="Dask scheduler tcp://HOST:PORT whose workers render, or local for processes here.")
    ] = None,
    backend: Annotated[
        str,
        Parameter(
            help="embree; mitsuba: the same fibers in Mitsuba 3, on a processor or a GPU; neural: a network instead of "
            "fibers, direct light only, fast; auto: fibers near, the network far."
        ),
    ] = "embree",
    device: Annotated[
        str | None, Parameter(help="With --backend mitsuba: auto (the default), llvm, cuda or scalar.")
    ] = None,
    fibers: Annotated[
        str | None,
        Parameter(help="With --backend mitsuba: tiled (the default with llvm), or flattened: all fibers, close-ups."),
    ] = None,
    reflection_weights: Annotated[
        Path | None,
        Parameter(help="With --backend neural: a file of usdfab train neural instead of the shipped or fabrics' own."),
    ] = None,
    transmission_weights: Annotated[Path | None, Parameter(help="The same for light from behind the cloth.")] = None,
    strict: Annotated[
        bool, Parameter(negative="", help="Stop at whatever is wrong with the stage instead of leaving it out.")
    ] = False,
    seed: Seed = 0,
    threads: Threads = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a fabric as a swatch under the capture rig, or a stage whose meshes wear fabrics.

    A stage without geometry is taken as a fabric. The same seed gives the same picture, bit for bit, on any number of
    threads or processes, in one piece, in regions, in tiles or resumed. Pictures are .exr (linear), .png, .jpg or .tif
    (sRGB). A render that is interrupted leaves OUTPUT.partial, from which --resume goes on.

    Usage examples:

        usdfab render fabric.usda -o swatch.png --resolution 720 --spp 256
        usdfab render samples/drape.usda --fabric fabric.usda -o drape.exr --resolution 1280x960 --noise 0.05
        usdfab render walk.usda -o walk.####.exr --frames 1-48 --aov depth,normal --scheduler tcp://farm:8786
        usdfab render cloth.usda -o check.exr --backend mitsuba --resolution 256 --device llvm
        usdfab render samples/drape.usda --fabric fabric.usda -o quick.png --backend neural

    Parameters
    ----------
    stage:
        A USD file.
    """
    from usdfab.cli.quick_start import load_numba

    if backend == "embree":
        load_numba()

    from usdfab.cli.picture import picture_options
    from usdfab.cli.render_files import RenderFile, plan_files
    from usdfab.cli.scene_source import SceneSource, frame_numbers
    from usdfab.errors import UsdfabError

    timing = {"--time": time, "--noise": noise}
    _check_backend(
        backend,
        {
            **({} if backend == "auto" else timing), "--aov": aov, "--denoise": denoise, "--tile": tile,
            "--checkpoint": checkpoint, "--resume": resume, "--workers": workers, "--scheduler": scheduler,
        },
        {"--device": device, "--fibers": fibers},
        {"--reflection-weights": reflection_weights, "--transmission-weights": transmission_weights},
    )  # fmt: skip
    target = output or Path(stage.stem + ".png")
    options = picture_options(target, aov, denoise, exposure, view, overwrite)
    part = parse_tile(tile)
    window = parse_region(region)
    size = parse_resolution(resolution)
    if not 0 <= seed < 2**63:
        raise UsdfabError(f"{seed} is not between 0 and 2^63 - 1", place="--seed")
    if workers is not None and (workers < 1 or scheduler not in (None, "local")):
        raise UsdfabError("--workers is a number of processes here, 1 or more", place="--workers")
    if frames is not None and (time_code is not None or checkpoint is not None):
        other = "--time-code" if time_code is not None else "--checkpoint"
        raise UsdfabError(f"does not go with {other}", place="--frames")
    numbers = frame_numbers(stage, frames) if frames is not None else None
    pictures = [(target, time_code)] if numbers is None else [(frame_path(target, n), n) for n in numbers]
    files = plan_files(pictures, part, checkpoint, resume, overwrite)

    from usdfab.cli.cluster import dask_executor
    from usdfab.cli.render_frame import FrameOptions, render_frame
    from usdfab.tracer.render import RenderSettings, thread_count

    samples = spp if spp is not None else 1 if backend == "neural" else 32
    settings = RenderSettings(size, samples, max_depth, seed, thread_count(threads), time, noise, part=part or (1, 1))
    texts = {"stage": stage, "fabric": fabric, "rig": rig}
    names = {name: str(path.absolute()) if path is not None else None for name, path in texts.items()}

    def source(file: RenderFile) -> SceneSource:
        return SceneSource(str(stage.absolute()), names["fabric"], names["rig"], camera, file.time_code, strict)

    if backend == "mitsuba":
        from usdfab.cli.render_mitsuba import render_mitsuba
    if backend in ("neural", "auto"):
        from usdfab.cli.render_auto import render_auto
        from usdfab.cli.render_neural import load_networks, render_neural

        files_of = {"reflection": reflection_weights, "transmission": transmission_weights}
        networks = load_networks(files_of, f"--backend {backend}")
        own = reflection_weights is None and transmission_weights is None
    results, warnings, worn = [], [], None
    place = "local" if scheduler is None and workers is not None else scheduler
    idle = place is None or all(file.finished for file in files)
    with nullcontext() if idle else dask_executor(str(place), workers, thread_count(threads)) as remote:
        for k, file in enumerate(files):
            label = f"rendering {file.output.name}" + (f" ({k + 1} of {len(files)})" if len(files) > 1 else "")
            frame = FrameOptions(settings, window, options, resume, label, quiet, json)
            if backend == "mitsuba":
                facts, said, worn_here = render_mitsuba(
                    source(file), file, frame, device or "auto", threads, fibers or "auto"
                )
            elif backend == "neural":
                facts, said, worn_here = render_neural(source(file), file, frame, networks, own)
            elif backend == "auto":
                facts, said, worn_here = render_auto(source(file), file, frame, networks, own)
            else:
                facts, said, worn_here = render_frame(source(file), file, frame, remote)
            results.append(facts)
            warnings += [warning for warning in said if warning not in warnings]
            worn = worn_here or worn
    if json:
        common = {"outputs": [file.output for file in files], "fabric": worn, "warnings": warnings}
        print_json(results[0] | common if numbers is None else {"frames": results} | common)


def _check_backend(
    backend: str, embree: dict[str, Any], mitsuba: dict[str, Any], neural: dict[str, Any]
) -> None:  # fmt: skip
    """Refuse options that are for other backends: ``embree``'s alone, ``mitsuba``'s and ``neural``'s."""
    from usdfab.errors import UsdfabError

    def given(options: dict[str, Any]) -> str | None:
        return next((name for name, value in options.items() if value is not None and value is not False), None)

    if backend not in ("embree", "mitsuba", "neural", "auto"):
        raise UsdfabError(
            f"there is no '{backend}'", place="--backend", remedy="choose embree or mitsuba, or neural to be quick"
        )
    if backend != "embree" and (wrong := given(embree)):
        name = "Mitsuba" if backend == "mitsuba" else backend
        raise UsdfabError(f"the {name} backend has no such option", place=wrong, remedy="use --backend embree")
    if backend != "mitsuba" and (wrong := given(mitsuba)):
        raise UsdfabError("is for --backend mitsuba", place=wrong)
    if backend not in ("neural", "auto") and (wrong := given(neural)):
        raise UsdfabError("is for --backend neural", place=wrong)
