"""``usdfab export``: a fabric as maps for programs that know no fibers."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from usdfab.cli.options import Json, Overwrite, Quiet, Seed, Threads, parse_resolution, print_json, progress_bar, say
from usdfab.errors import UsdfabError


def run(
    fabric: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Folder, or a .usdz or .u3ma file, to write.")],
    maps: Annotated[
        str | None,
        Parameter(help="Some of albedo,normal,roughness,height,opacity,orientation,ao; all by default."),
    ] = None,
    format: Annotated[Literal["png", "exr"], Parameter(help="Kind of map files.")] = "png",
    resolution: Annotated[str, Parameter(help="Texels, WIDTHxHEIGHT, or WIDTH alone for square texels.")] = "1024",
    repeats: Annotated[str, Parameter(help="Repeats of the weave on a map, COLUMNSxROWS.")] = "1x1",
    rays: Annotated[int | None, Parameter(help="Rays for each texel; by default 16 or more.")] = None,
    back: Annotated[bool, Parameter(negative="", help="Also bake the back (files back_*).")] = False,
    materialx: Annotated[bool, Parameter(negative="", help="Also wire the maps as MaterialX OpenPBR.")] = False,
    usdz: Annotated[bool, Parameter(negative="", help="Write one .usdz package.")] = False,
    u3m: Annotated[bool, Parameter(negative="", help="Write U3M 1.1: a folder, or a .u3ma file.")] = False,
    onnx: Annotated[
        bool, Parameter(negative="", help="Write the neural material's decoders as ONNX graphs instead: a folder.")
    ] = False,
    reflection_weights: Annotated[
        Path | None,
        Parameter(help="With --onnx: a file of usdfab train neural instead of the shipped or the fabric's own."),
    ] = None,
    transmission_weights: Annotated[Path | None, Parameter(help="The same for light from behind the cloth.")] = None,
    meters_per_uv: Annotated[
        str | None,
        Parameter(
            help="Cloth that one unit of texture coordinates covers, e.g. 1m or 4mm; the fabric's own, else 1 m."
        ),
    ] = None,
    prim: Annotated[str | None, Parameter(help="The fabric's Material, where the file holds several.")] = None,
    screenshot: Annotated[Path | None, Parameter(help="Also write the preview, all maps in one picture, here.")] = None,
    seed: Seed = 0,
    threads: Threads = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Bake a fabric into maps that tile without a seam, and wire them so that any viewer shows the cloth.

    Or, with --onnx, write its neural material as two graphs for engines that run networks (needs the onnx extra).

    The folder gets maps/*.png (or .exr), NAME_look.usda, a layer over the fabric's file (which is not changed) in which
    the same Material wears the maps as UsdPreviewSurface, and preview.png.

    Usage examples:

        usdfab export denim.usda -o denim
        usdfab export denim.usda -o denim --maps albedo,normal,roughness --resolution 2048 --repeats 2x2 --materialx
        usdfab export denim.usda --usdz -o denim.usdz
        usdfab export denim.usda --u3m -o denim.u3ma
        usdfab export denim.usda --onnx -o denim-onnx

    Parameters
    ----------
    fabric:
        A USD file that holds a fabric.
    """
    if onnx:
        from usdfab.cli.export_onnx import OnnxOptions, export_onnx

        maps_alone = {
            "--maps": maps, "--usdz": usdz, "--u3m": u3m, "--materialx": materialx, "--screenshot": screenshot,
            "--rays": rays, "--back": back, "--meters-per-uv": meters_per_uv,
        }  # fmt: skip
        wrong = next((name for name, value in maps_alone.items() if value is not None and value is not False), None)
        if wrong is not None:
            raise UsdfabError("does not go with --onnx", place=wrong, remedy="run the command twice")
        weights = (reflection_weights, transmission_weights)
        export_onnx(OnnxOptions(fabric, output, prim, *weights, overwrite, json, quiet))
        return
    if reflection_weights is not None or transmission_weights is not None:
        raise UsdfabError(
            "is for --onnx", place="--reflection-weights" if reflection_weights else "--transmission-weights"
        )
    from usdfab.cli.export_files import ExportOptions, export, kind_of
    from usdfab.fabric.fabric import parse_length
    from usdfab.tracer.bake import BakeSettings
    from usdfab.tracer.bake_files import parse_maps
    from usdfab.tracer.compilation import announce_compilation

    options = ExportOptions(
        kind_of(output, usdz, u3m),
        parse_maps(maps),
        BakeSettings(_texels(resolution), _repeats(repeats), rays, seed, threads),
        format,
        back,
        materialx,
        prim,
        None if meters_per_uv is None else parse_length(meters_per_uv),
        screenshot,
        overwrite,
    )
    announce = nullcontext() if quiet else announce_compilation(say)
    with announce, progress_bar("baking", quiet=quiet) as update:
        result = export(fabric, output, options, update)
    if not quiet:
        for warning in result.warnings:
            say(f"note: {warning}")
    if json:
        files = [str(file) for file in result.files]
        print_json({"output": output, "files": files, "warnings": result.warnings} | result.facts)
    elif not quiet:
        width, height = result.facts["front"]["resolution"]
        x, y = (1e3 * side for side in result.facts["front"]["size"])
        say(f"wrote {output}: {width} x {height} texels of {x:.3g} x {y:.3g} mm")


def _texels(text: str) -> tuple[int, int]:
    width, height = parse_resolution(text)
    return width, height


def _repeats(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    if not columns.isdigit() or not (rows or columns).isdigit() or int(columns) < 1 or int(rows or columns) < 1:
        raise UsdfabError(f"'{text}' are no repeats", place="--repeats", remedy="write e.g. 2x2")
    return int(columns), int(rows or columns)
