"""How a camera shows things: how sharply, which is one signed number, a blur or a sharpening, and in what contrast.

A picture's components at the frequencies k of the cosine transform (radians per pixel, mirrored borders) are
multiplied by

    exp(-b^2 k^2 / 2)          b >= 0, a Gaussian blur of standard deviation b
    2 - exp(-b^2 k^2 / 2)      b < 0, an unsharp mask of the same radius

which is smooth in ``b |b|`` at 0, keeps sums, and is its own transpose, so that derivatives go back through the same
function.

Cameras of cheap microscopes make pictures that please: bright things brighter, dark ones darker. Their response is
taken for a power of the light, ``toned``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]

PIVOT = 0.18
"""Light that all contrasts show alike: middle grey."""


def through_lens(picture: NDArray, blur: float) -> NDArray:
    """A picture as a lens or a sharpening filter shows it.

    Parameters
    ----------
    picture: (..., H, W, C)
        Linear light.
    blur:
        In pixels: the standard deviation of a Gaussian blur, or with a minus sign the radius of a sharpening.
    """
    if blur == 0.0:
        return picture
    down, across = blur_matrices(picture.shape[-3:-1], abs(blur))
    soft = np.einsum("ij,...jkc->...ikc", down, picture, optimize=True)
    soft = np.einsum("kl,...ilc->...ikc", across, soft, optimize=True).astype(picture.dtype, copy=False)
    return soft if blur > 0.0 else 2.0 * picture - soft


def toned(picture: NDArray, contrast: float) -> NDArray:
    """Light of 0 or more in the contrast of a camera; ``1 / contrast`` undoes it.

    ``PIVOT (x / PIVOT)^contrast``: 1 is a camera whose files say how much light there was.
    """
    if contrast == 1.0:
        return picture
    pivot, power = (picture.dtype.type(x) for x in (PIVOT, contrast))
    return pivot * (picture / pivot) ** power


def photographed(picture: NDArray, blur: float, exposure: float = 1.0, contrast: float = 1.0) -> NDArray:
    """A picture (..., H, W, C) as a photo shows it: through the lens, exposed, toned.

    Sharpening goes below black, which no photo does: that is 0.
    """
    seen = np.maximum(through_lens(picture, blur), picture.dtype.type(0.0))
    return toned(picture.dtype.type(exposure) * seen, contrast)


def through_lens_torch(image: Any, blur: float) -> Any:
    """:func:`through_lens` of a torch tensor (..., C, H, W)."""
    if blur == 0.0:
        return image
    down, across = (image.new_tensor(m) for m in blur_matrices(tuple(image.shape[-2:]), abs(blur)))
    soft = down @ image @ across
    return soft if blur > 0.0 else 2.0 * image - soft


def blur_matrices(shape: tuple[int, ...], deviation: float) -> tuple[Floats, Floats]:
    """Symmetric matrices (H, H) and (W, W) that blur columns and rows by a Gaussian, borders mirrored."""
    down, across = (_matrix(int(side), float(deviation)) for side in shape)
    return down, across


@lru_cache(maxsize=16)
def _matrix(side: int, deviation: float) -> Floats:
    frequencies = np.pi * np.arange(side) / side
    basis = fft.dct(np.eye(side), axis=0, norm="ortho")
    matrix = (basis.T * np.exp(-0.5 * (deviation * frequencies) ** 2)) @ basis
    matrix.flags.writeable = False
    return matrix
