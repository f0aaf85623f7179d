"""A photo and a fit laid over each other: where the fit's picture lies best, and how the two differ there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from usdfab.fabric import FabricParameters
from usdfab.imaging import linear_to_srgb, luminance, srgb_to_linear

MOST_SHIFT = 0.25
"""Of the picture's sides: how far the photo may be moved over the fit's picture, if its repeat is that large."""


def difference(
    photo: NDArray[np.float32], picture: NDArray[np.float32], fabric: FabricParameters
) -> tuple[NDArray[np.float32], float]:
    """How the fit's picture differs from the photo.

    A fit knows the weave, not where its repeat begins in the photo. So the middle of the photo is moved over the
    picture, by a repeat at most, to where the two resemble each other most.

    Parameters
    ----------
    photo: (h, w, 3)
        Linear, straightened, at the scale of ``picture``.
    picture: (H, W, 3)
        Linear, all of ``fabric.size``.

    Returns
    -------
    difference: (h', w', 3) linear
        Middle grey where both are alike, brighter where the fit is brighter, as half the difference of sRGB values.
    correlation:
        Of their luminances there, -1 to 1, shading that is slow over several yarns left out.
    """
    repeat = (fabric.weave.picks * fabric.cell[1] / fabric.size[1], fabric.weave.ends * fabric.cell[0] / fabric.size[0])
    height, width = picture.shape[:2]
    rows, columns = (
        min(have, max(8, round(side * (1.0 - min(part, 2.0 * MOST_SHIFT)))))
        for have, side, part in zip(photo.shape[:2], (height, width), repeat, strict=True)
    )
    top, left = (photo.shape[0] - rows) // 2, (photo.shape[1] - columns) // 2
    middle = photo[top : top + rows, left : left + columns]
    slow = 2.0 * min(fabric.cell[0] / fabric.size[0] * width, fabric.cell[1] / fabric.size[1] * height)
    a, b = (_structure(p, slow) for p in (middle, picture))
    products = signal.fftconvolve(b, a[::-1, ::-1], mode="valid")
    energy = signal.fftconvolve(b * b, np.ones_like(a), mode="valid")
    score = products / np.sqrt(np.maximum(energy, 1e-12) * max(float((a * a).sum()), 1e-12))
    y, x = np.unravel_index(int(np.argmax(score)), score.shape)
    there = picture[y : y + rows, x : x + columns]
    shown = 0.5 + 0.5 * (_encoded(there) - _encoded(middle))
    return np.asarray(srgb_to_linear(shown), dtype=np.float32), float(score[y, x])


def _encoded(pixels: NDArray) -> NDArray[np.float64]:
    return linear_to_srgb(np.clip(np.asarray(pixels, dtype=np.float64), 0.0, 1.0))


def _structure(pixels: NDArray, slow: float) -> NDArray[np.float64]:
    luma = luminance(_encoded(pixels))
    return luma - ndimage.gaussian_filter(luma, slow)
