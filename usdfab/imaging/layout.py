"""Pictures beside each other, for reports and comparisons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError

Color = tuple[float, float, float]


def side_by_side(images: Sequence[ArrayLike], gap: int = 8, background: Color = (1.0, 1.0, 1.0)) -> NDArray[np.float32]:
    """Images in one row, centred vertically, ``gap`` pixels of ``background`` (linear) between them.

    Images are (H, W, 3) or grey (H, W), linear, of any sizes. Returns (max H, sum W + gaps, 3) float32.
    """
    return grid(images, columns=max(1, len(images)), gap=gap, background=background)


def grid(
    images: Sequence[ArrayLike], columns: int, gap: int = 8, background: Color = (1.0, 1.0, 1.0)
) -> NDArray[np.float32]:
    """Images row by row in ``columns`` columns, each centred in its place; the last row may be short.

    A column is as wide as its widest image, a row as high as its highest. Returns (H, W, 3) float32, linear.

    Raises
    ------
    UsdfabError
        Without images, for arrays that are no images, and for a column count or gap that makes no sense.
    """
    if not images:
        raise UsdfabError("there is no image to lay out")
    if columns < 1 or gap < 0:
        raise UsdfabError(f"{columns} columns with a gap of {gap} pixels make no grid")
    pictures = [_color(image) for image in images]
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    heights, widths = np.zeros(rows, int), np.zeros(columns, int)
    for k, picture in enumerate(pictures):
        row, column = divmod(k, columns)
        heights[row] = max(heights[row], picture.shape[0])
        widths[column] = max(widths[column], picture.shape[1])
    top = np.r_[0, np.cumsum(heights + gap)]
    left = np.r_[0, np.cumsum(widths + gap)]
    sheet = np.empty((top[-1] - gap, left[-1] - gap, 3), np.float32)
    sheet[...] = background
    for k, picture in enumerate(pictures):
        row, column = divmod(k, columns)
        h, w = picture.shape[:2]
        y, x = top[row] + (heights[row] - h) // 2, left[column] + (widths[column] - w) // 2
        sheet[y : y + h, x : x + w] = picture
    return sheet


def _color(image: ArrayLike) -> NDArray[np.float32]:
    pixels = np.asarray(image, dtype=np.float32)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or pixels.size == 0:
        raise UsdfabError(f"an array of shape {pixels.shape} is no image (H, W, 3) or (H, W)")
    return pixels
