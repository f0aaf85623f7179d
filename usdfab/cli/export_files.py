"""What ``usdfab export`` writes: maps with a USD layer, a package, or a U3M."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, as_table
from usdfab.files import checked_output
from usdfab.imaging import write_image
from usdfab.imaging.u3m import (
    Document,
    Physics,
    Texture,
    Visual,
    construction_of,
    file_name,
    write_u3m,
    write_u3ma,
)
from usdfab.tracer.bake import BakeSettings, Side, bake
from usdfab.tracer.bake_files import LookMaps, MapFormat, preview, write_maps
from usdfab.tracer.bake_look import fit_look
from usdfab.usd.fabric_io import read_fabric
from usdfab.usd.look_layer import MapLook, cloth_scale, write_look
from usdfab.usd.usdz import checked_usdz, write_usdz

Kind = Literal["folder", "usdz", "u3m", "u3ma"]
MAPS_FOLDER, TEXTURES_FOLDER, PREVIEW = "maps", "textures", "preview.png"


@dataclass(frozen=True)
class ExportOptions:
    """The options of ``usdfab export``; names as there."""

    kind: Kind
    maps: tuple[str, ...]
    settings: BakeSettings
    format: MapFormat = "png"
    back: bool = False
    materialx: bool = False
    prim: str | None = None
    meters_per_uv: float | None = None
    screenshot: Path | None = None
    overwrite: bool = False


@dataclass
class Exported:
    """What was written, and what there is to say of it."""

    output: Path
    files: list[Path] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def kind_of(output: Path, usdz: bool, u3m: bool) -> Kind:
    """What is to be written, from the flags and the output's suffix.

    Raises
    ------
    UsdfabError
        Where they contradict each other.
    """
    suffix = output.suffix.lower()
    if usdz and u3m:
        raise UsdfabError("--usdz and --u3m are two formats", remedy="run the command twice")
    if (usdz and suffix != ".usdz") or (u3m and suffix not in ("", ".u3ma")):
        wanted = "fabric.usdz" if usdz else "a folder or fabric.u3ma"
        raise UsdfabError(f"'{output.name}' is not that format", place="--output", remedy=f"write e.g. -o {wanted}")
    if suffix in (".usdz", ".u3ma"):
        return suffix[1:]  # type: ignore[return-value]
    if suffix in (".usda", ".usdc", ".usd", ".png", ".exr"):
        raise UsdfabError("maps go into a folder", place=str(output), remedy="write e.g. -o maps")
    return "u3m" if u3m else "folder"


def export(source: Path, output: Path, options: ExportOptions, progress: Callable[[int, int], None]) -> Exported:
    """Bake the fabric of ``source`` and write it as ``options.kind`` says.

    Raises
    ------
    UsdfabError
        As all that it calls; files that exist are refused before any work.
    """
    fabric = read_fabric(source, options.prim)
    result = Exported(output)
    _check_outputs(source, output, fabric, options)
    if fabric.albedo_map:
        result.warnings.append("the albedo map is not in the baked maps: it lies over the cloth, they over one repeat")
    both = options.kind in ("u3m", "u3ma") or options.back
    sides: tuple[Side, ...] = ("front", "back") if both else ("front",)
    plain = replace(fabric, albedo_map="")
    baked = [
        LookMaps(maps, fit_look(plain, maps, threads=options.settings.threads))
        for maps in bake(plain, options.settings, sides, progress)
    ]
    result.facts = {side: one.facts() for side, one in zip(sides, baked, strict=True)}
    error = baked[0].look.error
    result.facts["brightness"] = {"sky": (1.0 + error[0]).tolist(), "lamp": (1.0 + error[1]).tolist()}
    _WRITERS[options.kind](source, fabric, baked, options, result)
    if options.screenshot is not None:
        result.files.append(write_image(options.screenshot, preview(baked[0]), overwrite=options.overwrite))
    return result


def _check_outputs(source: Path, output: Path, fabric: FabricParameters, options: ExportOptions) -> None:
    over = options.overwrite
    cloth_scale(source, options.prim, options.meters_per_uv)
    if options.kind == "usdz":
        checked_usdz(output, overwrite=over)
    elif options.kind == "u3ma":
        checked_output(output, (".u3ma",), overwrite=over)
    else:
        if output.exists() and not output.is_dir():
            raise UsdfabError("a file is in the folder's place", place=str(output), remedy="choose another name")
        if not output.parent.is_dir():
            place = str(output.parent)
            raise UsdfabError("the folder does not exist", place=place, remedy=f"create {place} first")
        main = f"{file_name(fabric.name)}.u3m" if options.kind == "u3m" else _look_name(source)
        files = [output / main, output / PREVIEW]
        files += [
            output / MAPS_FOLDER / f"{name}.{options.format}" for name in options.maps if options.kind == "folder"
        ]
        for file in files:
            if file.exists() and not over:
                raise UsdfabError("the file exists", place=str(file), remedy="choose another name or use --overwrite")
    if options.screenshot is not None:
        checked_output(options.screenshot, (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"), overwrite=over)


def _look_name(source: Path) -> str:
    return f"{source.stem}_look.usda"


def _folder(path: Path) -> Path:
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(path)) from error
    return path


def _write_folder(
    source: Path, fabric: FabricParameters, baked: list[LookMaps], options: ExportOptions, result: Exported
) -> None:
    folder = _folder(result.output)
    layer, files = _write_layer(source, folder, baked, options, options.format)
    result.files += [*files, layer, _write_preview(folder, baked[0], options)]
    result.facts["layer"] = str(layer)
    _say_scale(source, options, result)


def _write_usdz(
    source: Path, fabric: FabricParameters, baked: list[LookMaps], options: ExportOptions, result: Exported
) -> None:
    with _beside(result.output) as folder:
        # Packages hold PNG: not every reader of packages knows EXR.
        layer, _ = _write_layer(source, folder, baked, options, "png")
        path, warnings = write_usdz(layer, result.output, overwrite=options.overwrite)
    result.files.append(path)
    result.warnings += warnings
    _say_scale(source, options, result)


def _write_layer(
    source: Path, folder: Path, baked: list[LookMaps], options: ExportOptions, kind: MapFormat
) -> tuple[Path, list[Path]]:
    """Maps and the layer that wires those of the face."""
    maps = _folder(folder / MAPS_FOLDER)
    front = write_maps(maps, baked[0], options.maps, kind, overwrite=options.overwrite)
    files = list(front.values())
    for back in baked[1:]:
        files += write_maps(maps, back, options.maps, kind, prefix="back_", overwrite=options.overwrite).values()
    layer = write_look(
        source,
        folder / _look_name(source),
        _map_look(baked[0], front, kind),
        prim=options.prim,
        meters_per_uv=options.meters_per_uv,
        materialx=options.materialx,
        overwrite=options.overwrite,
    )
    return layer, files


def _map_look(baked: LookMaps, files: dict[str, Path], kind: MapFormat) -> MapLook:
    maps, look = baked.maps, baked.look
    coverage = float(maps.opacity.mean())
    red, green, blue = (max(t - (1.0 - coverage), 0.0) / max(coverage, 1e-6) for t in maps.transmittance)
    exr = kind == "exr"
    return MapLook(
        files=files,
        size=maps.size,
        signed_normals=exr,
        linear_albedo=exr,
        albedo=_mean_color(baked),
        roughness=float(look.roughness.mean()),
        opacity=coverage,
        ior=look.ior,
        transmittance=(red, green, blue),
        fuzz=maps.loose,
        facts=baked.facts(),
    )


def _mean_color(baked: LookMaps) -> tuple[float, float, float]:
    red, green, blue = baked.look.albedo.mean(axis=(0, 1), dtype=float)
    return float(red), float(green), float(blue)


def _write_preview(folder: Path, baked: LookMaps, options: ExportOptions) -> Path:
    return write_image(folder / PREVIEW, preview(baked), overwrite=options.overwrite)


def _say_scale(source: Path, options: ExportOptions, result: Exported) -> None:
    scale = cloth_scale(source, options.prim, options.meters_per_uv)
    result.facts["meters_per_uv"] = scale
    if options.meters_per_uv is None and scale == 1.0:
        result.warnings.append("one unit of texture coordinates is taken as one metre of cloth (--meters-per-uv)")


def _write_u3m_folder(
    source: Path, fabric: FabricParameters, baked: list[LookMaps], options: ExportOptions, result: Exported
) -> None:
    folder = _folder(result.output)
    result.files += _u3m_files(source, folder, fabric, baked, options)


def _write_u3m_archive(
    source: Path, fabric: FabricParameters, baked: list[LookMaps], options: ExportOptions, result: Exported
) -> None:
    with _beside(result.output) as folder:
        _u3m_files(source, folder, fabric, baked, options)
        result.files.append(write_u3ma(folder, result.output, _made(source), overwrite=options.overwrite))


U3M_NAMES = {
    "basecolor": "albedo",
    "normal": "normal",
    "roughness": "roughness",
    "alpha": "opacity",
    "displacement": "height",
}


def _u3m_files(
    source: Path, folder: Path, fabric: FabricParameters, baked: list[LookMaps], options: ExportOptions
) -> list[Path]:
    textures = _folder(folder / TEXTURES_FOLDER)
    pictures = [_write_preview(folder, baked[0], options)]
    visuals = []
    for side, one in zip(("front", "back"), baked, strict=True):
        names = [map_name for map_name in U3M_NAMES.values() if map_name in options.maps]
        files = write_maps(
            textures, one, names, "png", prefix=f"{side}_", grey_as_rgb=True, overwrite=options.overwrite
        )
        pictures += files.values()
        visuals.append(_visual(one, files))
    physics = Physics(thickness_mm=1e3 * baked[0].maps.thickness, construction=construction_of(fabric.weave))
    table = as_table(replace(fabric, albedo_map="", neural_weights=""))
    document = Document(
        fabric.name, visuals[0], visuals[1], physics, _made(source),
        description="Baked from fibers by usdfab.", custom={"usdfab": table},
    )  # fmt: skip
    return [*pictures, write_u3m(document, folder, overwrite=options.overwrite)]


def _visual(baked: LookMaps, files: dict[str, Path]) -> Visual:
    maps, look = baked.maps, baked.look
    size_mm = 1e3 * maps.size[0], 1e3 * maps.size[1]
    pixels = maps.opacity.shape[1], maps.opacity.shape[0]
    low, high = baked.height_range
    coverage = float(maps.opacity.mean())
    return Visual(
        textures={
            name: Texture(f"{TEXTURES_FOLDER}/{files[map_name].name}", size_mm, pixels)
            for name, map_name in U3M_NAMES.items()
            if map_name in files
        },
        constants={
            "basecolor": _mean_color(baked),
            "roughness": float(look.roughness.mean()),
            "alpha": coverage,
            "displacement": 1e3 * float(maps.height.mean()),
        },
        displacement=(1e3 * low, 1e3 * high),
        ior=look.ior,
    )


def _made(source: Path) -> datetime:
    """When the fabric's file was last changed: exports of the same file are the same."""
    return datetime.fromtimestamp(int(source.stat().st_mtime), timezone.utc)


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """A folder for work that is thrown away, on the target's drive."""
    try:
        with tempfile.TemporaryDirectory(prefix=".usdfab-", dir=target.parent) as name:
            yield Path(name)
    except OSError as error:
        raise UsdfabError(f"cannot be written ({os.strerror(error.errno or 0)})", place=str(target)) from error


_WRITERS: dict[Kind, Callable[..., None]] = {
    "folder": _write_folder,
    "usdz": _write_usdz,
    "u3m": _write_u3m_folder,
    "u3ma": _write_u3m_archive,
}
