"""How far apart two images are. Images are linear (H, W, 3) or (H, W) arrays of one shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError

RELATIVE_FLOOR = 1e-2
"""Added to the squared reference in ``relmse`` so that black pixels do not rule the mean."""


def mse(image: ArrayLike, reference: ArrayLike) -> float:
    """Mean squared error over all pixels and channels."""
    a, b = _pair(image, reference)
    return float(np.mean((a - b) ** 2))


def relmse(image: ArrayLike, reference: ArrayLike, floor: float = RELATIVE_FLOOR) -> float:
    """Relative mean squared error, ``mean((a - b)^2 / (b^2 + floor))``, as in Rousselle et al. 2011, section 6."""
    a, b = _pair(image, reference)
    return float(np.mean((a - b) ** 2 / (b**2 + floor)))


def psnr(image: ArrayLike, reference: ArrayLike, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, ``10 log10(peak^2 / mse)``; infinite for equal images."""
    error = mse(image, reference)
    return math.inf if error == 0 else 10.0 * math.log10(peak**2 / error)


def _pair(image: ArrayLike, reference: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(image, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape:
        raise UsdfabError(
            f"images of shape {a.shape} and {b.shape} cannot be compared", remedy="render both at the same resolution"
        )
    if a.size == 0:
        raise UsdfabError("an empty image cannot be compared")
    return a, b
