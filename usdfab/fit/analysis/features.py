"""Feature maps of a photo: encoded luminance, opponent colours, fiber orientation, edge energy.

Every map is (H, W) float64 in image frame (row 0 at the top). Orientation is measured on the gradient structure tensor:
``orientation`` is positive where the fibers run vertically (warp on top) and negative where they run horizontally.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.imaging.color import linear_to_srgb

Array = NDArray[np.float64]

LUMA_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Features:
    """Maps that the later steps read; all (H, W) unless stated.

    Parameters
    ----------
    encoded: (H, W, 3)
        The photo with the sRGB transfer curve applied, close to perceptual steps.
    luma:
        Encoded luminance with the slow shading removed, local deviation about 1.
    orientation:
        ``(Jxx - Jyy) / (Jxx + Jyy + floor)``, in [-1, 1]; positive = vertical structures, yarn borders included.
    fibers:
        The same on the photo with equalised fine contrast: positive = vertical fibers.
    energy:
        Log gradient energy, normalised as ``luma``.
    tensor: (3, H, W)
        The smoothed fine structure tensor Jxx, Jyy, Jxy (y down).
    """

    encoded: Array
    luma: Array
    orientation: Array
    fibers: Array
    energy: Array
    tensor: Array


def normalise(x: Array, sigma: float) -> Array:
    """Remove the slow part of ``x`` and divide by its local deviation, both over a Gaussian of ``sigma`` pixels."""
    high = x - ndimage.gaussian_filter(x, sigma)
    deviation = np.sqrt(ndimage.gaussian_filter(high * high, sigma))
    return high / (deviation + 0.3 * high.std() + 1e-9)


def structure_tensor(luma: Array, fine: float, window: float) -> Array:
    """(3, H, W) tensor Jxx, Jyy, Jxy of ``luma`` at gradient scale ``fine`` averaged over ``window`` (pixels)."""
    gx = ndimage.gaussian_filter(luma, fine, order=(0, 1))
    gy = ndimage.gaussian_filter(luma, fine, order=(1, 0))
    return np.stack([ndimage.gaussian_filter(p, window) for p in (gx * gx, gy * gy, gx * gy)])


def extract(linear: Array) -> Features:
    """All maps of a linear RGB photo (H, W, 3) in [0, 1]."""
    encoded = linear_to_srgb(np.clip(linear, 0.0, 1.0))
    size = min(encoded.shape[:2])
    luma = encoded @ LUMA_WEIGHTS
    # Coarse: every edge counts, so yarn borders lead. Fine: contrast is equalised first, so single fibers lead.
    tensor = structure_tensor(luma, 1.2, size / 120)
    fine = structure_tensor(normalise(luma, size / 140), 1.0, size / 100)
    total = tensor[0] + tensor[1]
    floor = 0.3 * np.median(total) + 1e-12
    return Features(
        encoded=encoded,
        luma=normalise(luma, size / 8),
        orientation=(tensor[0] - tensor[1]) / (total + floor),
        fibers=(fine[0] - fine[1]) / (fine[0] + fine[1] + 0.3 * np.median(fine[0] + fine[1]) + 1e-12),
        energy=normalise(np.log(total + floor), size / 8),
        tensor=fine,
    )
