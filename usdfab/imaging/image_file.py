"""Reading image files into linear Rec. 709, with the size of a pixel where the file knows it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging.color import decoding_table, srgb_to_linear
from usdfab.imaging.openimageio import captured_stderr, openimageio
from usdfab.imaging.resolution import PixelSize, pixel_size_from_tags

MAX_SIDE = 20_000
"""Longest side that is read, in pixels."""

VECTOR_LAYER_CHANNELS = (("R", "G", "B"), ("X", "Y", "Z"), ("U", "V"))
"""Channel endings that make up one layer of three or two."""

_HARMLESS = ("extraneous bytes before marker",)
"""JPEG complaints about pictures that are whole all the same; cheap microscopes write such files."""


@dataclass(frozen=True)
class Image:
    """A picture.

    Parameters
    ----------
    pixels: (H, W, 3) float32
        Linear Rec. 709, first row at the top.
    pixel_size: (width, height) metres, or None
        Size of a pixel in the world, None where the file does not say.
    notes:
        Sentences for a report: what was found, dropped or ignored.
    """

    pixels: NDArray[np.float32]
    pixel_size: PixelSize | None = None
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> PixelSize | None:
        """Width and height of the whole picture in metres, or None."""
        if self.pixel_size is None:
            return None
        return self.pixels.shape[1] * self.pixel_size[0], self.pixels.shape[0] * self.pixel_size[1]


def read_image(path: str | Path) -> Image:
    """Read a picture file.

    Whole numbers (8 and 16 bit files) are decoded by the exact sRGB curve unless the file says that it is linear;
    floating-point files (EXR, HDR, float TIFF) are taken as linear. EXIF orientation is applied, grey is repeated
    into three channels, transparent pixels are composited over black. Of several pictures in a file the first is read.

    Raises
    ------
    UsdfabError
        For a file that is missing, a folder, empty, not readable, no image, damaged, cut off, without colour
        channels, longer than ``MAX_SIDE`` on a side, or has NaN or infinite pixels.
    """
    place = str(path)
    oiio = openimageio()
    with _Reader(path) as reader:
        spec = reader.spec
        tags = {item.name: item.value for item in spec.extra_attribs}
        names = list(spec.channelnames)
        color = _color_channels(names, spec.nchannels, spec.alpha_channel, place)
        codes = spec.format in (oiio.TypeDesc("uint8"), oiio.TypeDesc("uint16"))
        data = reader.pixels(str(spec.format) if codes else "float")
    notes = []

    linear_file = np.issubdtype(_numpy_type(spec.format), np.floating)
    linear_file = linear_file or str(tags.get("oiio:ColorSpace", "")).lower().startswith("lin")
    # A slice is a view; a list of channels copies the whole picture, plane by plane.
    neighbours = color == list(range(color[0], color[-1] + 1))
    pixels = _decoded(data[..., color[0] : color[-1] + 1] if neighbours else data[..., color], linear_file)
    if not np.isfinite(pixels).all():
        raise UsdfabError("the picture has NaN or infinite pixels", place=place, remedy="repair or crop it")
    profile = tags.get("ICCProfile:profile_description")
    if profile and "srgb" not in str(profile).lower():
        notes.append(f"the embedded colour profile '{profile}' is ignored, colours are read as sRGB")

    if spec.alpha_channel >= 0:
        alpha = _decoded(data[..., [spec.alpha_channel]], linear=True)
        if alpha.min() < 1.0:
            notes.append("transparent pixels are composited over black")
            if tags.get("oiio:UnassociatedAlpha"):
                pixels = pixels * alpha

    size, origin = pixel_size_from_tags(tags)
    notes.append(origin)
    orientation = int(tags.get("Orientation", 1))
    if 2 <= orientation <= 8:
        pixels = _oriented(pixels, orientation)
        notes.append(f"turned upright by its EXIF orientation {orientation}")
        if size and orientation >= 5:
            size = (size[1], size[0])
    if len(color) == 1:
        pixels = np.repeat(pixels, 3, axis=-1)
    return Image(np.ascontiguousarray(pixels), size, tuple(notes))


def read_layers(path: str | Path) -> dict[str, NDArray[np.float32]]:
    """All layers of an EXR file by name, as ``write_image`` writes them.

    The picture itself is called ``""``; ``albedo.R``, ``albedo.G``, ``albedo.B`` become ``albedo`` of shape
    (H, W, 3), ``uv.U`` and ``uv.V`` become ``uv`` of shape (H, W, 2), a single channel such as ``Z`` has shape (H, W).
    Values are as stored, float32; infinite ones are kept.

    Raises
    ------
    UsdfabError
        For a file that cannot be read, as ``read_image``.
    """
    with _Reader(path) as reader:
        names = list(reader.spec.channelnames)
        data = reader.pixels("float")
    layers: dict[str, NDArray[np.float32]] = {}
    taken: set[str] = set()
    for prefix in dict.fromkeys(name.rpartition(".")[0] for name in names):
        for endings in VECTOR_LAYER_CHANNELS:
            group = [f"{prefix}.{ending}" if prefix else ending for ending in endings]
            if all(name in names for name in group) and not taken.intersection(group):
                layers[prefix] = np.ascontiguousarray(data[..., [names.index(name) for name in group]])
                taken.update(group)
    for k, name in enumerate(names):
        if name not in taken:
            layers[name] = np.ascontiguousarray(data[..., k])
    return layers


class _Reader:
    """An open image file whose every complaint becomes one UsdfabError."""

    def __init__(self, path: str | Path) -> None:
        self.place = str(path)
        self.path = _checked_input(path)

    def __enter__(self) -> _Reader:
        oiio = openimageio()
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        with captured_stderr():
            oiio.geterror()
            self._input = oiio.ImageInput.open(str(self.path), config)
            if self._input is None:
                reason = _one_line(oiio.geterror())
                raise UsdfabError(
                    f"not an image that can be read ({reason})",
                    place=self.place,
                    remedy="give a PNG, JPEG, TIFF or EXR file",
                )
        self.spec = self._input.spec()
        width, height = self.spec.width, self.spec.height
        if width < 1 or height < 1 or self.spec.nchannels < 1 or self.spec.deep or self.spec.depth > 1:
            self._input.close()
            raise UsdfabError("holds no flat picture", place=self.place, remedy="give a PNG, JPEG, TIFF or EXR file")
        if max(width, height) > MAX_SIDE:
            self._input.close()
            raise UsdfabError(
                f"{width} x {height} pixels are too many",
                place=self.place,
                remedy=f"crop it, or scale it down, to at most {MAX_SIDE} on a side",
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._input.close()

    def pixels(self, kind: str) -> NDArray[Any]:
        """All channels, (H, W, C), as ``kind`` ("uint8", "uint16" or "float")."""
        try:
            with captured_stderr():
                data = self._input.read_image(0, 0, 0, self.spec.nchannels, kind)
                complaint = _one_line(self._input.geterror())
                if data is None or (complaint and not any(phrase in complaint for phrase in _HARMLESS)):
                    raise UsdfabError(
                        f"the image is damaged or cut off ({complaint or 'no pixels'})",
                        place=self.place,
                        remedy="copy or export it again",
                    )
        except MemoryError as error:
            raise UsdfabError("not enough memory for this image", place=self.place, remedy="crop it") from error
        return data.reshape(self.spec.height, self.spec.width, self.spec.nchannels)


def _checked_input(path: str | Path) -> Path:
    """``path`` if a file with something in it is there."""
    file, place = Path(path), str(path)
    try:
        if not file.exists():
            raise UsdfabError("there is no such file", place=place, remedy="check the name")
        if not file.is_file():
            raise UsdfabError("is a folder, not an image", place=place, remedy="give an image file")
        if file.stat().st_size == 0:
            raise UsdfabError("the file is empty", place=place, remedy="copy or export it again")
    except OSError as error:
        raise UsdfabError(f"cannot be opened ({error.strerror})", place=place, remedy="check the name") from error
    if not os.access(file, os.R_OK):
        raise UsdfabError("may not be read", place=place, remedy="check its permissions")
    return file


def _color_channels(names: list[str], count: int, alpha: int, place: str) -> list[int]:
    """Which channels are red, green, blue; one alone is grey."""
    upper = [name.upper() for name in names]
    if all(name in upper for name in "RGB"):
        return [upper.index(name) for name in "RGB"]
    for single in ("Y", "I", "L", "GRAY"):
        if single in upper:
            return [upper.index(single)]
    left = [k for k in range(count) if k != alpha]
    if len(left) == 1:
        return left
    for prefix in dict.fromkeys(name.rpartition(".")[0] for name in names):
        group = [f"{prefix}.{ending}" for ending in "RGB"]
        if all(name in names for name in group):
            return [names.index(name) for name in group]
    raise UsdfabError(
        f"has channels {', '.join(names[:8])}, none of them colour", place=place, remedy="give an RGB or grey image"
    )


def _decoded(data: NDArray[Any], linear: bool) -> NDArray[np.float32]:
    """Codes or floats to linear float32."""
    if data.dtype in (np.uint8, np.uint16):
        if linear:
            return data.astype(np.float32) / np.float32(np.iinfo(data.dtype).max)
        return decoding_table(8 * data.dtype.itemsize)[data]
    return np.asarray(data if linear else srgb_to_linear(data), dtype=np.float32)


def _oriented(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Undo an EXIF orientation 2 to 8 (EXIF 2.32, tag 274: where row 0 and column 0 of the file are in the scene)."""
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _numpy_type(format_: Any) -> np.dtype[Any]:
    return np.dtype({"half": "float16", "float": "float32", "double": "float64"}.get(str(format_), "uint8"))


def _one_line(text: str) -> str:
    return " ".join(text.split())[:160]
