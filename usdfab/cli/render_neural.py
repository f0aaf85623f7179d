"""One picture of ``usdfab render --backend neural``."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from usdfab.cli.options import progress_bar, say
from usdfab.cli.picture import write_pixels
from usdfab.cli.render_files import RenderFile
from usdfab.cli.render_frame import Facts, FrameOptions
from usdfab.cli.scene_source import SceneSource, read_textures
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.neural.material_file import Weights
    from usdfab.neural.render import NeuralRender
    from usdfab.usd.scene import Camera, Mesh, Scene


def load_networks(files: Mapping[str, Path | None], what: str = "--backend neural") -> dict[str, Weights]:
    """The networks for light from the front and from behind: those given, else those that ship with usdfab."""
    from usdfab.neural.extra import require_neural_extra

    require_neural_extra(what)
    from usdfab.neural.material_file import load_material_network

    return {kind: load_material_network(files.get(kind), kind) for kind in ("reflection", "transmission")}


def render_neural(
    source: SceneSource, file: RenderFile, options: FrameOptions, networks: Mapping[str, Weights], own: bool = True
) -> tuple[Facts, list[str], str | None]:
    """Render one picture. Returns what ``--json`` says of it, warnings, and the name of the fabric put on.

    ``own``: fabrics that name a network of their own are drawn with it.
    """
    from usdfab.neural.render import render
    from usdfab.neural.stage_scene import build
    from usdfab.tracer.compilation import announce_compilation
    from usdfab.tracer.render import resolve_region, resolve_resolution

    scene, override = source.read()
    scene, pictures = read_textures(scene, source.strict)
    if not scene.cameras:
        raise UsdfabError("the stage has no camera", place=source.stage, remedy="add a UsdGeomCamera")
    camera, settings = scene.cameras[0], options.settings
    said = left_out(scene, camera)
    if said and source.strict:
        raise UsdfabError(said[0], remedy="use --backend embree, or leave --strict out")
    size = resolve_resolution(camera, settings.resolution)
    region = resolve_region(options.region.pixels(*size) if options.region else None, *size)
    if settings.spp < 1:
        raise UsdfabError(f"{settings.spp} samples are none", place="--spp", remedy="give 1 or more")
    ready = build(scene, networks, pictures, source.strict, own)
    announce = nullcontext() if options.quiet else announce_compilation(say)
    with announce, progress_bar(options.label, quiet=options.quiet) as update:
        done = render(ready, camera, size, region, settings.spp, settings.threads or 1, update)
    write_pixels(file.output, done.pixels, done.region, done.size, options.picture)
    warnings = [*scene.warnings, *said, *ready.warnings]
    if not options.quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        if not options.json:
            say(_line(file, done))
    return _facts(file, done), warnings, override.name if override else None


def left_out(scene: Scene, camera: Camera) -> list[str]:
    """What the backend does not draw of a scene, one sentence each."""
    said = []
    if camera.lens_radius > 0.0:
        said.append(f"{camera.path}: the neural backend has no depth of field, all is sharp")
    if camera.to_world_close is not None or any(_moves(mesh) for mesh in scene.meshes):
        said.append(f"{scene.path}: the neural backend has no motion blur, the shutter's opening is shown")
    return said


def _moves(mesh: Mesh) -> bool:
    return mesh.points_close is not None or mesh.placements_close is not None


def _facts(file: RenderFile, done: NeuralRender) -> Facts:
    height, width = done.pixels.shape[:2]
    return {
        "output": file.output,
        "backend": "neural",
        "width": width,
        "height": height,
        "region": list(done.region),
        "full_size": list(done.size),
        "spp": done.spp,
        "seconds": round(done.seconds, 3),
        "decodes": done.decodes,
    }


def _line(file: RenderFile, done: NeuralRender) -> str:
    height, width = done.pixels.shape[:2]
    rate = done.decodes / max(done.seconds, 1e-9) / 1e6
    what = f"{width} x {height}, {done.spp} spp, {done.seconds:.2f} s"
    return f"wrote {file.output}: {what}, neural, {done.decodes / 1e6:.2f} million answers, {rate:.2f} million a second"
