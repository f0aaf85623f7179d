"""The photo that a fit works on: read, cropped, measured in metres, and not larger than what can be worked with."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import SIZE_RANGE
from usdfab.imaging import read_image

DEFAULT_WIDTH = 5e-3
"""Width in metres that a photo is taken to have when nothing says how large it is."""

WORKING_SIDE = 1024
"""A photo whose shorter side is at least twice as long is averaged down; no stage looks at more pixels than 720."""

TOP = 0.98
"""Linear value from which a pixel counts as clipped: 253 of 255; cameras stop a little below the end."""

MOST_ASPECT = 4.0
"""Of longer photos the middle is taken: a lattice needs yarns both ways."""

TAGGED = "the file's resolution"
NOT_SQUARE = 0.01

ALARMING, NOTED = ("transparent", "colour profile"), ("turned upright",)
"""Words of those remarks of the image reader that are warnings, and of those that a person may want to know."""

Crop = Callable[[int, int], tuple[int, int, int, int]]
"""From width and height of the picture in pixels to (x0, y0, x1, y1), from the top left, upper ends excluded."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo to fit.

    Parameters
    ----------
    pixels: (H, W, 3) float32
        Linear Rec. 709, upright, cropped, averaged down where it was very large.
    width:
        Physical width of ``pixels`` in metres.
    size_source:
        Where the physical size comes from.
    clipped: (high, low)
        Fractions of the cropped photo's pixels with a channel at the top of its range, and with all at the bottom,
        counted before averaging.
    sha256:
        Of the file.
    box: (x0, y0, x1, y1) or None
        The crop in pixels of the file.
    notes, warnings:
        Sentences for people: what was done, and what may be wrong.
    """

    pixels: NDArray[np.float32]
    width: float
    size_source: str
    clipped: tuple[float, float]
    sha256: str
    box: tuple[int, int, int, int] | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def load_photo(
    path: str | Path, width: float | None = None, pixel_size: float | None = None, crop: Crop | None = None
) -> Photo:
    """Read a photo.

    Parameters
    ----------
    path:
        PNG, JPEG, TIFF, EXR or what else ``read_image`` reads.
    width, pixel_size:
        Physical width of the whole picture, before the crop, or of one of its pixels, in metres. Without both, the
        file's resolution tags count; without those, ``DEFAULT_WIDTH``.
    crop:
        The part to use.

    Raises
    ------
    UsdfabError
        As ``read_image``; for sizes that contradict each other or are not plausible; for a crop outside the picture.
    """
    image = read_image(path)
    pixels = image.pixels
    rows, columns = pixels.shape[:2]
    width, source = _physical_width(columns, width, pixel_size, image.pixel_size)
    meters = width / columns
    notes = [note for note in image.notes if any(word in note for word in NOTED)]
    warnings = [note for note in image.notes if any(word in note for word in ALARMING)]
    tagged = image.pixel_size
    if source == TAGGED and tagged is not None and abs(tagged[0] / tagged[1] - 1.0) > NOT_SQUARE:
        size = f"{tagged[0] * 1e6:.4g} x {tagged[1] * 1e6:.4g} µm"
        warnings.append(f"the file says that pixels are {size}; their width is taken for both")
    box = None if crop is None else _checked_crop(crop(columns, rows), columns, rows)
    if box is not None:
        x0, y0, x1, y1 = box
        pixels = pixels[y0:y1, x0:x1]
        notes.append(f"cropped to {x1 - x0} x {y1 - y0} of {columns} x {rows} pixels")
    pixels, warning = _middle(pixels)
    warnings += warning
    brightest = np.maximum(np.maximum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
    clipped = (float((brightest >= TOP).mean()), float((brightest <= 1e-6).mean()))
    del brightest
    factor = max(1, min(pixels.shape[:2]) // WORKING_SIDE)
    if factor > 1:
        notes.append(f"averaged over {factor} x {factor} pixels, from {pixels.shape[1]} x {pixels.shape[0]}")
        pixels = averaged(pixels, factor)
    return Photo(
        np.ascontiguousarray(pixels),
        meters * factor * pixels.shape[1],
        source,
        clipped,
        hashlib.sha256(Path(path).read_bytes()).hexdigest(),
        box,
        tuple(notes),
        tuple(warnings),
    )


def averaged(pixels: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means (H // factor, W // factor, 3) of blocks of pixels; rows and columns that fill no block are left out."""
    rows, columns = (n // factor for n in pixels.shape[:2])
    result = np.zeros((rows, columns, 3), dtype=np.float32)
    # One plane of a block at a time: no copy of the large picture.
    for dy in range(factor):
        for dx in range(factor):
            result += pixels[dy : rows * factor : factor, dx : columns * factor : factor]
    result /= np.float32(factor * factor)
    return result


def _middle(pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], list[str]]:
    sides = pixels.shape[:2]
    longest = int(MOST_ASPECT * min(sides))
    if max(sides) <= longest:
        return pixels, []
    axis = int(np.argmax(sides))
    start = (sides[axis] - longest) // 2
    kept = pixels[start : start + longest] if axis == 0 else pixels[:, start : start + longest]
    return kept, [f"only the middle of the long photo is used, {kept.shape[1]} x {kept.shape[0]} pixels"]


def _checked_crop(box: tuple[int, int, int, int], columns: int, rows: int) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = box
    if not (0 <= x0 < x1 <= columns and 0 <= y0 < y1 <= rows):
        raise UsdfabError(
            f"{x0},{y0},{x1},{y1} is no part of a picture of {columns} x {rows} pixels",
            place="--crop",
            remedy="give x0 < x1 and y0 < y1 within the picture, from its top left corner",
        )
    return box


def _physical_width(
    columns: int, width: float | None, pixel_size: float | None, tagged: tuple[float, float] | None
) -> tuple[float, str]:
    if width is not None and pixel_size is not None:
        raise UsdfabError("--size and --pixel-size both say how large the photo is", remedy="use one of them")
    if width is not None:
        value, source = width, "--size"
    elif pixel_size is not None:
        value, source = pixel_size * columns, "--pixel-size"
    elif tagged is not None:
        value, source = tagged[0] * columns, TAGGED
    else:
        value, source = DEFAULT_WIDTH, "default"
    if not SIZE_RANGE[0] <= value <= SIZE_RANGE[1]:
        raise UsdfabError(f"a photo {value:g} m wide (from {source}) is not plausible", remedy="use --size, e.g. 3.6mm")
    return value, source
