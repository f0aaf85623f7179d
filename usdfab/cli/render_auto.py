"""One picture of ``usdfab render --backend auto``: fibers where yarns are seen, the neural cloth where they are not."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from usdfab.cli.options import progress_bar, say
from usdfab.cli.picture import write_pixels
from usdfab.cli.render_files import RenderFile
from usdfab.cli.render_frame import Facts, FrameOptions
from usdfab.cli.scene_source import SceneSource, read_textures
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.neural.material_file import Weights

NEURAL_SAMPLES = 4
"""Of each pixel of the neural cloth: it has no noise, but an edge within it may have steps."""


def render_auto(
    source: SceneSource, file: RenderFile, options: FrameOptions, networks: Mapping[str, Weights], own: bool = True
) -> tuple[Facts, list[str], str | None]:
    """Render one picture. Returns what ``--json`` says of it, warnings, and the name of the fabric put on.

    ``own``: fabrics that name a network of their own are drawn with it from afar.
    """
    from usdfab.neural.far_look import far_share, matched_scene
    from usdfab.neural.render import render
    from usdfab.neural.stage_scene import build
    from usdfab.tracer import Tracer
    from usdfab.tracer.accumulate import ThreadRunner, accumulate
    from usdfab.tracer.compilation import announce_compilation
    from usdfab.tracer.film import RGB, SAMPLES
    from usdfab.tracer.render import resolve_region, start
    from usdfab.tracer.schedule import Work

    scene, override = source.read()
    scene, pictures = read_textures(scene, source.strict)
    if not scene.cameras:
        raise UsdfabError("the stage has no camera", place=source.stage, remedy="add a UsdGeomCamera")
    camera, settings = scene.cameras[0], options.settings
    began = time.perf_counter()
    shot, work = start(camera, settings)
    size = (shot.width, shot.height)
    region = resolve_region(options.region.pixels(*size) if options.region else None, *size)
    if options.region is not None:
        shot, work = start(camera, replace(settings, region=region))
    ready = build(scene, networks, pictures, source.strict, own)
    tracer = Tracer(scene, pictures, source.strict)
    threads = settings.threads or 1
    announce = nullcontext() if options.quiet else announce_compilation(say)
    share, far, decodes = np.zeros((region[3] - region[1], region[2] - region[0])), None, 0
    with announce:
        # What moves or is out of focus has no footprint here: fibers.
        if camera.lens_radius == 0.0 and camera.to_world_close is None:
            share = far_share(ready, scene, camera, size, region)
        if share.any():
            matched = matched_scene(ready, scene, camera, size, tracer, seed=settings.seed, threads=threads)
            found = render(matched, camera, size, region, NEURAL_SAMPLES, threads)
            far, decodes = found.pixels, found.decodes
        tiles = [t for t in work.tiles if (_cut(share, t.window, region) < 1.0).any()]
        near = np.zeros((*share.shape, 3), dtype=np.float32)
        if tiles:
            left = Work(tiles)
            with (
                ThreadRunner(partial(tracer.sample, shot), threads) as runner,
                progress_bar(options.label, quiet=options.quiet) as update,
            ):
                accumulate(
                    left, runner, settings.spp, noise=settings.noise, gain=2.0**camera.exposure,
                    time_limit=settings.time_limit, progress=update,
                )  # fmt: skip
            for tile in tiles:
                sums = left.part(tile.window)
                mean = sums[..., RGB : RGB + 3] / np.maximum(sums[..., SAMPLES, None], 1.0)
                place = _cut(near, tile.window, region)
                place[...] = 2.0**camera.exposure * _cut(mean, region, tile.window)
    pixels = near if far is None else (near + share[..., None] * (far - near)).astype(np.float32)
    write_pixels(file.output, pixels, region, size, options.picture)
    warnings = [*scene.warnings, *ready.warnings, *(w for w in tracer.warnings if w not in ready.warnings)]
    seconds = time.perf_counter() - began
    facts = {
        "output": file.output, "backend": "auto", "width": pixels.shape[1], "height": pixels.shape[0],
        "region": list(region), "full_size": list(size), "spp": settings.spp, "seconds": round(seconds, 3),
        "decodes": decodes, "neural": round(float(share.mean()), 4),
        "tiles": len(work.tiles), "tiles_traced": len(tiles),
    }  # fmt: skip
    if not options.quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        if not options.json:
            say(
                f"wrote {file.output}: {pixels.shape[1]} x {pixels.shape[0]}, {seconds:.1f} s, "
                f"{100 * share.mean():.0f} % of it neural, {len(tiles)} of {len(work.tiles)} tiles traced"
            )
    return facts, warnings, override.name if override else None


def _cut(picture: np.ndarray, window: tuple[int, int, int, int], frame: tuple[int, int, int, int]) -> np.ndarray:
    """The part of a picture of ``frame`` that lies in ``window``, as a view."""
    x0, y0 = max(window[0], frame[0]), max(window[1], frame[1])
    x1, y1 = min(window[2], frame[2]), min(window[3], frame[3])
    return picture[y0 - frame[1] : y1 - frame[1], x0 - frame[0] : x1 - frame[0]]
