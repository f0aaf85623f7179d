"""Rectification: the photo resampled so that every crossing becomes a square of ``SUB`` x ``SUB`` samples.

A yarn system with frequency f has the phase ``f . x + delta(x) / (2 pi)`` in yarns; delta, found by demodulating the
features with f, follows uneven spacing, shear and lens distortion. Cell coordinates: u counts warp yarns to the right,
v counts weft rows *upwards* (row 0 at the bottom of the photo).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from usdfab.fit.analysis.features import Array
from usdfab.fit.analysis.spectrum import Peak

SUB = 8
"""Samples per cell and direction in a rectified map."""
STEP = 4
"""Pixels per sample of the phase fields."""


@dataclass(frozen=True)
class Phase:
    """Yarn phase of one system: ``u(x, y) = fx x + fy y + field``, in yarns; y down.

    ``field`` is sampled every STEP pixels; ``coherence`` in [0, 1] is 1 where it is the same all over the photo.
    """

    fx: float
    fy: float
    field: Array
    coherence: float

    def shift_at(self, x: Array, y: Array) -> Array:
        """The field at pixel positions, in yarns."""
        return ndimage.map_coordinates(self.field, [y / STEP, x / STEP], order=1, mode="nearest")


@dataclass(frozen=True)
class Grid:
    """Sample positions of a rectified map: pixel ``x``, ``y`` and ``inside``, each (rows * SUB, columns * SUB).

    Row 0 is the lowest weft of the photo: the first axis runs up.
    """

    x: Array
    y: Array
    inside: np.ndarray

    def sample(self, image: Array) -> Array:
        """``image`` (..., H, W) at the grid, nearest pixel: blur the image first."""
        iy = np.clip(np.round(self.y), 0, image.shape[-2] - 1).astype(np.intp)
        ix = np.clip(np.round(self.x), 0, image.shape[-1] - 1).astype(np.intp)
        return image[..., iy, ix]


def demodulate(maps: list[Array], peak: Peak, spacing: float) -> Phase:
    """Phase field of the yarn system with frequency ``peak`` from feature maps, smoothed over 1.5 ``spacing``."""
    h, w = maps[0].shape
    y, x = np.mgrid[0:h, 0:w]
    carrier = np.exp(-2j * np.pi * (peak.fx * x + peak.fy * y))
    window = np.outer(np.hanning(h), np.hanning(w))
    window /= window.sum()
    # Smooth at reduced resolution: block means first, the Gaussian after.
    hb, wb = h // STEP, w // STEP
    total = np.zeros((hb, wb), dtype=complex)
    for m in maps:
        z = m * carrier
        amplitude = (z * window).sum()
        block = z[: hb * STEP, : wb * STEP].reshape(hb, STEP, wb, STEP).mean((1, 3))
        total += np.conj(amplitude) * block / m.var()
    sigma = 1.5 * spacing / STEP
    smooth = _smooth(total.real, sigma) + 1j * _smooth(total.imag, sigma)
    rms = np.sqrt(np.mean(np.abs(smooth) ** 2)) + 1e-30
    coherence = float(np.abs(smooth.mean()) / rms)
    # Where the local amplitude is poor the phase stays near that of the whole photo.
    delta = np.angle(smooth + 0.3 * rms)
    # Block centre of sample k is at pixel STEP k + (STEP - 1) / 2; resample to pixel STEP k.
    shift = (STEP - 1) / (2 * STEP)
    yy, xx = np.mgrid[0:hb, 0:wb]
    field = ndimage.map_coordinates(delta, [yy - shift, xx - shift], order=1, mode="nearest")
    return Phase(peak.fx, peak.fy, field / (2 * np.pi), coherence)


def _smooth(x: Array, sigma: float) -> Array:
    return ndimage.gaussian_filter(x, sigma, mode="constant", truncate=3)


def build_grid(warp: Phase, weft: Phase, shape: tuple[int, int], offset: tuple[float, float] = (0.0, 0.0)) -> Grid:
    """Grid of a photo of ``shape`` (H, W); cell boundaries at phase integers plus ``offset`` (u, v)."""
    h, w = shape
    m = np.array([[warp.fx, warp.fy], [-weft.fx, -weft.fy]])
    inverse = np.linalg.inv(m)
    corners = np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]) @ m.T - np.array(offset)
    low = np.floor(corners.min(0) - 0.25).astype(int)
    high = np.ceil(corners.max(0) + 0.25).astype(int) + 1  # one more, so that every cell offset finds room
    u = (np.arange((high[0] - low[0]) * SUB) + 0.5) / SUB + low[0] + offset[0]
    v = (np.arange((high[1] - low[1]) * SUB) + 0.5) / SUB + low[1] + offset[1]
    uu, vv = np.meshgrid(u, v)
    x = inverse[0, 0] * uu + inverse[0, 1] * vv
    y = inverse[1, 0] * uu + inverse[1, 1] * vv
    for _ in range(3):
        du, dv = uu - warp.shift_at(x, y), vv + weft.shift_at(x, y)
        x, y = inverse[0, 0] * du + inverse[0, 1] * dv, inverse[1, 0] * du + inverse[1, 1] * dv
    inside = (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    return Grid(x, y, inside)
