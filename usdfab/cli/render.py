"""``usdfab render``: a swatch of a fabric, or a stage whose meshes wear fabrics."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from usdfab.cli.options import (
    Denoise,
    Json,
    OptionalOutput,
    Overwrite,
    Quiet,
    Resolution,
    Seed,
    Threads,
    parse_resolution,
    print_json,
    progress_bar,
    say,
)

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters
    from usdfab.usd.scene import Scene


def run(
    stage: Path,
    /,
    *,
    output: OptionalOutput = None,
    fabric: Annotated[Path | None, Parameter(help="A fabric file to put on the cloth of the stage.")] = None,
    rig: Annotated[Path | None, Parameter(help="Capture-rig stage for a swatch: camera, light, plane.")] = None,
    camera: Annotated[str | None, Parameter(help="Prim path of the camera; the stage's first by default.")] = None,
    resolution: Resolution = "640",
    spp: Annotated[int, Parameter(help="Samples per pixel.")] = 32,
    time: Annotated[float | None, Parameter(help="Seconds after which to stop, if spp are not reached.")] = None,
    max_depth: Annotated[int, Parameter(help="Longest path; 2 is direct light only.")] = 64,
    time_code: Annotated[float | None, Parameter(help="Time code of the stage to render.")] = None,
    aov: Annotated[bool, Parameter(negative="", help="EXR only: also albedo, normal, Z, alpha, variance.")] = False,
    denoise: Denoise = False,
    seed: Seed = 0,
    threads: Threads = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a fabric as a swatch under the capture rig, or a stage whose meshes wear fabrics.

    A stage without geometry is taken as a fabric. The same seed gives the same picture, bit for bit, on any number of
    threads. Pictures are .exr (linear), .png, .jpg or .tif (sRGB).

    Usage examples:

        usdfab render fabric.usda -o swatch.png --resolution 720 --spp 256
        usdfab render samples/drape.usda --fabric fabric.usda -o drape.exr --resolution 1280x960

    Parameters
    ----------
    stage:
        A USD file.
    """
    from usdfab import imaging
    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.imaging.image_output import OUTPUT_SUFFIXES

    target = output or Path(stage.stem + ".png")
    checked_output(target, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    if aov and target.suffix.lower() != ".exr":
        raise UsdfabError("only .exr files hold further layers", place="--aov", remedy="write to an .exr file")
    if denoise:
        imaging.check_denoiser()
    size = parse_resolution(resolution)
    if not 0 <= seed < 2**63:
        raise UsdfabError(f"{seed} is not between 0 and 2^63 - 1", place="--seed")

    scene, override = _scene(stage, fabric, rig, camera, time_code)
    from usdfab.tracer import RenderSettings, Tracer

    if not scene.cameras:
        raise UsdfabError("the stage has no camera", place=str(stage), remedy="add a UsdGeomCamera")
    if not quiet:
        for warning in scene.warnings:
            say(f"warning: {warning}")
    settings = RenderSettings(size, spp, max_depth, seed, threads, time)
    with progress_bar(f"rendering {target.name}", quiet=quiet) as update:
        result = Tracer(scene, _textures(scene)).render(scene.cameras[0], settings, update)
    aovs = None
    if aov:
        aovs = {
            "albedo": result.albedo,
            "normal": result.normal,
            "Z": result.depth,
            "alpha": result.alpha,
            "variance": result.variance,
        }
    pixels = result.pixels
    if denoise:
        pixels = imaging.denoise(pixels, result.albedo, result.normal)
    imaging.write_image(target, pixels, overwrite=overwrite, aovs=aovs)
    height, width = result.pixels.shape[:2]
    if json:
        print_json(
            {
                "output": target,
                "width": width,
                "height": height,
                "spp": result.spp,
                "seconds": round(result.seconds, 3),
                "rays": result.rays,
                "fiber_segments": result.patch_segments,
                "fabric": override.name if override else None,
                "warnings": scene.warnings,
            }
        )
    elif not quiet:
        rate = result.rays / max(result.seconds, 1e-9) / 1e6
        say(f"wrote {target}: {width} x {height}, {result.spp} spp, {result.seconds:.1f} s, {rate:.2f} million rays/s")


def _scene(
    stage: Path, fabric: Path | None, rig: Path | None, camera: str | None, time_code: float | None
) -> tuple[Scene, FabricParameters | None]:
    """The scene to render, and the fabric that was put on it, if any."""
    from usdfab.errors import UsdfabError
    from usdfab.usd.fabric_io import fabric_prims, read_fabric
    from usdfab.usd.read_scene import read_scene
    from usdfab.usd.rig import swatch_scene
    from usdfab.usd.stage import has_geometry, open_stage

    opened = open_stage(stage)
    if not has_geometry(opened) and fabric_prims(opened):
        if fabric is not None:
            raise UsdfabError("--fabric needs a stage with cloth to put it on", place=str(stage))
        return swatch_scene(read_fabric(stage), rig), None
    if rig is not None:
        raise UsdfabError("--rig is for fabrics; this stage has geometry of its own", place=str(stage))
    override = read_fabric(fabric) if fabric is not None else None
    return read_scene(stage, time_code, camera, override), override


def _textures(scene: Scene) -> dict:
    from usdfab.imaging import read_image
    from usdfab.usd.scene import DomeLight

    paths = [light.texture_path for light in scene.lights if isinstance(light, DomeLight) and light.texture_path]
    return {path: read_image(path).pixels for path in paths}
