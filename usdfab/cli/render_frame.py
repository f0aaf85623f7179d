"""One picture of ``usdfab render``: read the scene, sample it here or elsewhere, write the file."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from usdfab.cli.cluster import ExecutorRunner
from usdfab.cli.options import Region, progress_bar, say
from usdfab.cli.picture import PictureOptions, render_facts, render_line, write_picture
from usdfab.cli.preview import Preview
from usdfab.cli.render_files import RenderFile
from usdfab.cli.scene_source import SceneSource, read_textures, scene_fingerprint
from usdfab.errors import UsdfabError
from usdfab.tracer import Tracer
from usdfab.tracer.accumulate import Runner, ThreadRunner, accumulate
from usdfab.tracer.checkpoint import Autosave, Identity, resume_work, save_work
from usdfab.tracer.compilation import announce_compilation
from usdfab.tracer.film import RAYS
from usdfab.tracer.render import RenderSettings, Shot, develop, resolve_resolution, start
from usdfab.tracer.schedule import Work
from usdfab.usd.scene import Scene


@dataclass(frozen=True)
class FrameOptions:
    """What all frames have in common. ``region`` waits for the picture's size, which the camera decides."""

    settings: RenderSettings
    region: Region | None
    picture: PictureOptions
    resume: bool
    label: str
    quiet: bool
    json: bool


Facts = dict[str, Any]
Remote = tuple[Executor, int] | None
"""An executor and the number of tiles that it does at once; None: threads of this process."""


def render_frame(
    source: SceneSource, file: RenderFile, options: FrameOptions, remote: Remote
) -> tuple[Facts, list[str], str | None]:
    """Render one picture or part. Returns what ``--json`` says of it, warnings, and the name of the fabric put on."""
    if file.finished:
        if not options.quiet:
            say(f"{file.output} is there already")
        return {"output": file.output, "skipped": True}, [], None
    scene, override = source.read()
    scene, textures = read_textures(scene, source.strict)
    warnings: list[str] = []

    def warn(text: str, *, always: bool = False) -> None:
        warnings.append(text)
        if always or not options.quiet:
            say(f"warning: {text}")

    for warning in scene.warnings:
        warn(warning)
    if not scene.cameras:
        raise UsdfabError("the stage has no camera", place=source.stage, remedy="add a UsdGeomCamera")
    camera, settings = scene.cameras[0], options.settings
    if options.region is not None:
        settings = replace(settings, region=options.region.pixels(*resolve_resolution(camera, settings.resolution)))
    shot, work = start(camera, settings)
    facts = _render(source, scene, textures, shot, work, settings, file, options, remote, warn)
    return facts, warnings, override.name if override else None


def _render(
    source: SceneSource,
    scene: Scene,
    textures: dict,
    shot: Shot,
    work: Work,
    settings: RenderSettings,
    file: RenderFile,
    options: FrameOptions,
    remote: Remote,
    warn: Any,
) -> Facts:
    print_of_scene = scene_fingerprint(scene, textures)
    with _runner(source, scene, textures, print_of_scene, shot, settings, remote) as (runner, segments, said, tracer):
        for warning in said:
            warn(warning)
        identity = Identity.of(print_of_scene, shot, settings, segments)
        before = 0.0
        if options.resume and file.partial.exists():
            saved = resume_work(file.partial, identity)
            work, before = saved.work, saved.seconds
        else:
            file.partial.unlink(missing_ok=True)  # --overwrite: it is not to be taken for this one
        autosave = Autosave(file.partial, identity, settings.spp, partial(warn, always=True), before)
        try:
            shown = Preview(file, tracer, shot, options.picture, quiet=options.quiet)
            with shown, announce_compilation(shown.show), progress_bar(options.label, quiet=options.quiet) as update:
                seconds = before + accumulate(
                    work,
                    runner,
                    settings.spp,
                    noise=settings.noise,
                    gain=2.0**shot.camera.exposure,
                    time_limit=settings.time_limit,
                    progress=update,
                    save=autosave,
                )
        except BaseException:
            if autosave.saved and not options.quiet:
                say(f"the unfinished render is kept in {file.partial}; --resume goes on with it")
            raise
    try:
        facts, line = _write(file, shot, work, settings, identity, seconds, options.picture)
    except UsdfabError:
        # A full disk, a folder that went away: hours of work are not to be lost with it.
        with suppress(UsdfabError):
            save_work(file.partial, identity, work, settings.spp, seconds)
            say(f"the render is kept in {file.partial}; --resume writes the picture")
        raise
    autosave.remove()
    if not (options.quiet or options.json):
        say(line)
    return facts


@contextmanager
def _runner(
    source: SceneSource, scene: Scene, textures: dict, wanted: str, shot: Shot, settings: RenderSettings, remote: Remote
) -> Iterator[tuple[Runner, int, tuple[str, ...], Tracer | None]]:
    """Who samples tiles, how many fiber segments the scene has, the tracer's warnings, and the tracer if it is here."""
    if remote is not None:
        executor, slots = remote
        elsewhere = ExecutorRunner(executor, slots, source, wanted, shot)
        yield elsewhere, *elsewhere.about(), None
        return
    tracer = Tracer(scene, textures, source.strict)
    with ThreadRunner(partial(tracer.sample, shot), settings.threads or 1) as here:
        yield here, tracer.segments, tracer.warnings, tracer


def _write(
    file: RenderFile,
    shot: Shot,
    work: Work,
    settings: RenderSettings,
    identity: Identity,
    seconds: float,
    picture: PictureOptions,
) -> tuple[Facts, str]:
    """Write the picture or the part; returns what is to be said of it as JSON and as a line."""
    if file.output == file.picture:
        size = (shot.width, shot.height)
        render = develop(work, identity.region, size, shot.camera.exposure, seconds, identity.segments)
        write_picture(file.output, render, picture)
        return render_facts(file.output, render), render_line(file.output, render)
    part = Work(work.tiles, work.sums.copy(), work.stops)
    part.keep_wanted()
    save_work(file.output, identity, part, settings.spp, seconds)
    return _part_facts(file, part, settings, seconds)


def _part_facts(file: RenderFile, work: Work, settings: RenderSettings, seconds: float) -> tuple[Facts, str]:
    counts = work.counts()[[tile.wanted for tile in work.tiles]] if work.tiles else np.zeros(1, dtype=np.int64)
    i, n = settings.part
    facts = {
        "output": file.output,
        "tile": f"{i}/{n}",
        "spp": round(float(counts.mean())),
        "spp_min": int(counts.min()),
        "spp_max": int(counts.max()),
        "seconds": round(seconds, 3),
        "rays": float(work.sums[..., RAYS].sum()),
    }
    return facts, f"wrote {file.output}: tile {i}/{n}, {facts['spp']} spp, {seconds:.1f} s"
