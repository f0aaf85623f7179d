"""One picture of ``usdfab render --backend mitsuba``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from usdfab.cli.options import progress_bar, say
from usdfab.cli.picture import write_pixels
from usdfab.cli.render_files import RenderFile
from usdfab.cli.render_frame import Facts, FrameOptions
from usdfab.cli.scene_source import SceneSource, read_textures
from usdfab.errors import UsdfabError
from usdfab.mi.render import MitsubaRender, MitsubaSettings, render
from usdfab.mi.variant import resolve_device
from usdfab.tracer.render import resolve_region, resolve_resolution
from usdfab.tracer.texture_reader import TextureReader
from usdfab.tracer.textures import load_texture_images
from usdfab.usd.scene import Scene, Texture


def render_mitsuba(
    source: SceneSource, file: RenderFile, options: FrameOptions, device: str, threads: int | None, fibers: str = "auto"
) -> tuple[Facts, list[str], str | None]:
    """Render one picture. Returns what ``--json`` says of it, warnings, and the name of the fabric put on."""
    device = resolve_device(device)  # before any work
    scene, override = source.read()
    scene, pictures = read_textures(scene, source.strict)
    scene = _readable(scene, source.strict)
    if not scene.cameras:
        raise UsdfabError("the stage has no camera", place=source.stage, remedy="add a UsdGeomCamera")
    camera, common = scene.cameras[0], options.settings
    size = resolve_resolution(camera, common.resolution)
    region = resolve_region(options.region.pixels(*size) if options.region else None, *size)
    settings = MitsubaSettings(
        size, region, common.spp, common.max_depth, common.seed, device, threads, fibers=fibers,  # type: ignore[arg-type]
    )  # fmt: skip
    with progress_bar(options.label, quiet=options.quiet) as update:
        done = render(scene, camera, settings, pictures=pictures, textures=TextureReader(), progress=update)
    write_pixels(file.output, done.pixels, done.region, done.size, options.picture)
    warnings = [*scene.warnings, *done.warnings]
    if not options.quiet:
        for warning in warnings:
            say(f"warning: {warning}")
        if not options.json:
            say(_line(file, done))
    return _facts(file, done), warnings, override.name if override else None


def _readable(scene: Scene, strict: bool) -> Scene:
    """The scene without the textures whose images cannot be read, which its warnings name; an error if ``strict``."""
    maps = [surface.albedo_map for surface in scene.fabrics if surface.albedo_map]
    wanted = [t for m in scene.materials if m.fabric < 0 for t in m.textures.values()] + maps
    images, warnings = load_texture_images(wanted, strict)

    def there(texture: Texture | None) -> bool:
        return texture is not None and texture.file in images

    materials = [replace(m, textures={k: t for k, t in m.textures.items() if there(t)}) for m in scene.materials]
    fabrics = [replace(f, albedo_map=f.albedo_map if there(f.albedo_map) else None) for f in scene.fabrics]
    said = (*scene.warnings, *warnings)
    return replace(scene, materials=tuple(materials), fabrics=tuple(fabrics), warnings=said)


def _noise(done: MitsubaRender) -> float | None:
    """Relative standard error of the whole picture's pixels; None where one sample tells nothing."""
    if not np.isfinite(done.variance).all():
        return None
    level: NDArray[np.float64] = np.asarray(done.pixels, dtype=float).mean()
    return float(np.sqrt(done.variance.mean()) / max(float(level), 1e-9))


def _facts(file: RenderFile, done: MitsubaRender) -> Facts:
    height, width = done.pixels.shape[:2]
    noise = _noise(done)
    return {
        "output": file.output,
        "backend": "mitsuba",
        "device": done.device,
        "width": width,
        "height": height,
        "region": list(done.region),
        "full_size": list(done.size),
        "spp": done.spp,
        "noise": None if noise is None else round(noise, 6),
        "seconds": round(done.seconds, 3),
        "fibers": None if not done.points else "tiled" if done.tiled else "flattened",
        "control_points": done.points,
    }


def _line(file: RenderFile, done: MitsubaRender) -> str:
    height, width = done.pixels.shape[:2]
    kind = "tiles of" if done.tiled else "fibers of"
    points = f", {kind} {done.points} control points" if done.points else ""
    what = f"{width} x {height}, {done.spp} spp, {done.seconds:.1f} s"
    return f"wrote {file.output}: {what}, Mitsuba ({done.device}){points}"
