"""Baked maps as files: how each is encoded, their facts, and a picture of them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging import grid, srgb_to_linear
from usdfab.imaging.texture_file import write_texture
from usdfab.tracer.bake import BakedMaps
from usdfab.tracer.bake_filter import Map
from usdfab.tracer.bake_look import Look

MapFormat = Literal["png", "exr"]
MAPS = ("albedo", "normal", "roughness", "height", "opacity", "orientation", "ao")
"""Names of the maps, in the order in which they are written and shown."""
SIXTEEN_BITS = ("normal", "height")
"""PNG maps of 16 bits: slopes and heights show steps at 8."""
PREVIEW_SIDE = 320
"""Pixels of a picture in the preview, at most."""


@dataclass(frozen=True, eq=False)
class LookMaps:
    """What is written: the maps of one side with the look that was fitted to them."""

    maps: BakedMaps
    look: Look

    def values(self, name: str) -> Map:
        """(H, W) or (H, W, 3) a map in its own unit: orientation has its coherence as a third channel."""
        if name == "albedo":
            return self.look.albedo
        if name == "normal":
            return self.look.normal
        if name == "roughness":
            return self.look.roughness
        if name == "orientation":
            vector = self.maps.orientation
            return np.concatenate([vector, np.linalg.norm(vector, axis=-1, keepdims=True)], axis=-1)
        return getattr(self.maps, name)

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest place in metres: 0 and 1 of the PNG map."""
        low, high = float(self.maps.height.min()), float(self.maps.height.max())
        return low, max(high, low + 1e-9)

    def codes(self, name: str) -> Map:
        """A map as numbers of [0, 1], as PNG files hold them."""
        values = self.values(name)
        if name == "normal":
            return 0.5 + 0.5 * values
        if name == "orientation":
            return np.concatenate([0.5 + 0.5 * values[..., :2], values[..., 2:]], axis=-1)
        if name == "height":
            low, high = self.height_range
            return (values - np.float32(low)) / np.float32(high - low)
        return values

    def facts(self) -> dict[str, Any]:
        """What the files do not say themselves, as plain data: lengths in metres."""
        low, high = self.height_range
        return {
            "size": list(self.maps.size),
            "resolution": [self.maps.opacity.shape[1], self.maps.opacity.shape[0]],
            "raysPerTexel": self.maps.rays,
            "heightLow": low,
            "heightHigh": high,
            "thickness": self.maps.thickness,
            "coverage": float(self.maps.opacity.mean()),
            "transmittance": list(self.maps.transmittance),
            "ior": self.look.ior,
            "normalStrength": self.look.strength,
        }


def parse_maps(text: str | None) -> tuple[str, ...]:
    """Names of maps from ``albedo,normal``; all by default. ``UsdfabError`` for a name that does not exist."""
    if text is None:
        return MAPS
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in MAPS]
    if unknown or not names:
        raise UsdfabError(f"there is no map '{','.join(unknown)}'", place="--maps", remedy=f"use {', '.join(MAPS)}")
    return tuple(name for name in MAPS if name in names)


def write_maps(
    folder: Path,
    baked: LookMaps,
    names: Sequence[str] = MAPS,
    kind: MapFormat = "png",
    *,
    prefix: str = "",
    grey_as_rgb: bool = False,
    overwrite: bool = False,
) -> dict[str, Path]:
    """Write maps as ``folder/PREFIXname.png`` or ``.exr``; returns the files by name.

    PNG: albedo in sRGB and the others as codes of [0, 1] (normal and orientation halved and shifted, heights between
    ``heightLow`` and ``heightHigh``). EXR: the values themselves, heights in metres, vectors from -1 to 1.

    Parameters
    ----------
    grey_as_rgb:
        Write single numbers three times, for readers that know no grey files.
    """
    files = {}
    for name in names:
        values = baked.values(name) if kind == "exr" else baked.codes(name)
        if grey_as_rgb and values.ndim == 2:
            values = np.repeat(values[..., None], 3, axis=-1)
        files[name] = write_texture(
            folder / f"{prefix}{name}.{kind}",
            values,
            color=name == "albedo",
            bits=16 if name in SIXTEEN_BITS else 8,
            texel=baked.maps.texel,
            overwrite=overwrite,
            metadata=_header(name, baked, kind),
        )
    return files


def _header(name: str, baked: LookMaps, kind: MapFormat) -> dict[str, str]:
    width, height = baked.maps.size
    said = f"{name} of {1e3 * width:.6g} x {1e3 * height:.6g} mm of cloth"
    if name == "height":
        low, high = baked.height_range
        said += "; in metres" if kind == "exr" else f"; black is {1e3 * low:.6g} mm, white {1e3 * high:.6g} mm"
    return {"ImageDescription": said}


def preview(baked: LookMaps, names: Sequence[str] = MAPS) -> NDArray[np.float32]:
    """A picture of the maps beside each other, linear: first the cloth, 2 x 2 repeats, under a raking lamp."""
    pictures = [_shrunk(np.tile(lit(baked), (2, 2, 1)))]
    for name in names:
        codes = _shrunk(baked.codes(name))
        # Numbers are shown as the greys that they are as codes.
        pictures.append(codes if name == "albedo" else srgb_to_linear(codes).astype(np.float32))
    return grid(pictures, columns=4)


def lit(baked: LookMaps) -> NDArray[np.float32]:
    """(H, W, 3) the map of one repeat under a sky and a lamp from the upper left, linear, for looking at only."""
    lamp = np.array([-0.45, 0.55, 0.7], dtype=np.float32)
    lamp /= np.linalg.norm(lamp)
    # The true normals: the look's lean less.
    shade = np.clip(baked.maps.normal @ lamp, 0.0, None) / lamp[2]
    light = 0.45 + 0.75 * shade
    color = baked.look.albedo * light[..., None] * baked.maps.opacity[..., None]
    brightest = float(np.quantile(color, 0.995))
    return (color * (0.8 / max(brightest, 1e-6) if brightest > 0 else 1.0)).astype(np.float32)


def _shrunk(values: Map) -> Map:
    """Means of whole blocks of texels, so that neither side is above ``PREVIEW_SIDE`` by much."""
    step = max(1, -(-max(values.shape[:2]) // PREVIEW_SIDE))
    values = values[..., None] if values.ndim == 2 else values
    rows, columns = values.shape[0] // step, values.shape[1] // step
    if rows and columns:
        cut = values[: rows * step, : columns * step]
        values = cut.reshape(rows, step, columns, step, -1).mean(axis=(1, 3))
    return np.repeat(values, 3, axis=-1) if values.shape[-1] == 1 else values
