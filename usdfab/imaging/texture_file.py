"""Writing textures: colours and data that tile a surface, with their physical size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from usdfab.errors import UsdfabError
from usdfab.files import checked_output
from usdfab.imaging.image_output import describe, encoded, save_pixels
from usdfab.imaging.openimageio import openimageio
from usdfab.imaging.resolution import PixelSize

TEXTURE_SUFFIXES = (".png", ".exr")
"""Kinds of files that textures are written as."""


def write_texture(
    path: str | Path,
    values: ArrayLike,
    *,
    color: bool,
    bits: int = 8,
    texel: PixelSize | None = None,
    overwrite: bool = False,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write a texture, whole or not at all.

    ``.png`` holds codes of [0, 1], what is outside is clipped: sRGB encoded for colours, as they are for data.
    ``.exr`` holds the values themselves: half floats for colours, 32-bit floats for data.

    Parameters
    ----------
    values: (H, W, 3) or (H, W)
        Linear Rec. 709 for colours. One number for each texel makes a grey image.
    color:
        Whether these are colours; else data (normals, heights, ...), which no program may convert.
    bits:
        PNG: 8 or 16.
    texel: (width, height) metres
        Written into the resolution tags.

    Raises
    ------
    UsdfabError
        As ``write_image``.
    """
    target = checked_output(path, TEXTURE_SUFFIXES, overwrite=overwrite, kind="textures")
    place, exr = str(target), target.suffix.lower() == ".exr"
    pixels = np.asarray(values, dtype=np.float32)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.size == 0:
        raise UsdfabError(f"an array of shape {pixels.shape} is no texture", place=place)
    if not np.isfinite(pixels).all():
        raise UsdfabError("some texels are NaN or infinite", place=place)
    if bits not in (8, 16):
        raise UsdfabError(f"{bits} bits are not possible", place=place, remedy="use 8 or 16")
    if exr:
        kind = "half" if color else "float"
    else:
        kind = f"uint{bits}"
        top = 2**bits - 1
        pixels = encoded(pixels, bits) if color else np.round(np.clip(pixels, 0.0, 1.0) * top).astype(f"u{bits // 8}")
    oiio = openimageio()
    names = ("Y",) if pixels.shape[2] == 1 else ("R", "G", "B")
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.channelnames = names
    describe(spec, target.suffix.lower(), texel, metadata or {})
    if not color:
        # Readers that honour profiles must not convert data.
        spec.attribute("oiio:ColorSpace", "data")
    save_pixels(oiio, target, spec, np.ascontiguousarray(pixels))
    return target
