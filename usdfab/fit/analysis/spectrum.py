"""Candidate yarn frequencies: peaks of the whitened power spectrum near the two image axes.

In a regular weave each yarn system repeats with its own spacing whatever the weave, so its frequency vector is a
spectral peak close to an axis; float repeats and colour stripes add further ones. All strong ones are returned, the
choice is made later together with the weave. Frequencies are vectors (fx, fy) in cycles per pixel, y down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from usdfab.fit.analysis.features import Array, Features, normalise
from usdfab.fit.analysis.known import COUNT_SLACK

WEDGE = np.radians(18.0)
"""Largest angle between a yarn frequency and its image axis."""
HARMONIC = 0.7
"""Share of the power at the double frequency that counts for a peak: yarns have sharp borders."""
SKEW_SIGMA = np.radians(2.5)
TURN_SIGMA = np.radians(7.0)
STRUCTURE_SIGMA = np.radians(5.0)
"""Deviations of the non-orthogonality, the rotation, and the rotation against the edge directions."""
STRENGTH_WEIGHT = 3.0
"""Nats per factor e of peak strength."""


@dataclass(frozen=True)
class Peak:
    """A spectral peak: frequency (cycles per pixel), power over the local background, angle to its image axis.

    ``strength`` includes part of the power at twice the frequency. ``tilt`` is in radians, positive clockwise in the
    image (y down), so that a rotated photo tilts both systems alike.
    """

    fx: float
    fy: float
    strength: float
    tilt: float


def power(features: Features) -> tuple[Array, Array, Array]:
    """Whitened power summed over luma, orientation and energy: (map, fx axis, fy axis), zero frequency centred."""
    h, w = features.luma.shape
    window = np.outer(np.hanning(h), np.hanning(w))
    shape = (2 * h, 2 * w)
    fy = np.fft.fftshift(np.fft.fftfreq(shape[0]))
    fx = np.fft.fftshift(np.fft.fftfreq(shape[1]))
    cycles = np.hypot(*np.meshgrid(fx * min(h, w), fy * min(h, w)))
    ring = np.minimum(np.round(4 * np.log2(np.maximum(cycles, 1.0))).astype(int), 40)
    maps = [features.luma, normalise(features.orientation, min(h, w) / 8), features.energy]
    total = np.zeros(shape)
    for m in maps:
        p = np.abs(np.fft.fftshift(np.fft.fft2((m - m.mean()) * window, shape))) ** 2
        mean = np.bincount(ring.ravel(), p.ravel(), 41) / np.maximum(np.bincount(ring.ravel(), minlength=41), 1)
        mean = ndimage.gaussian_filter1d(mean, 1.5) + 1e-12
        total += p / mean[ring]
    return total / len(maps), fx, fy


def axis_peaks(
    spectrum: tuple[Array, Array, Array], axis: int, size: int, count: int = 8, near: float | None = None
) -> list[Peak]:
    """The strongest peaks near the x axis (``axis`` 0, warp) or the y axis (1, weft) of :func:`power`.

    ``size`` is the image extent in pixels along that axis; frequencies from 2.5 cycles per image to one cycle per 8
    pixels are considered; where the cycles per image are known to be ``near`` a number, only those about it, and if
    none of these is a peak, this number itself.
    """
    p, fx, fy = spectrum
    gx, gy = np.meshgrid(fx, fy)
    along, across = (gx, gy) if axis == 0 else (gy, gx)
    allowed = (along * size >= 2.5) & (along <= 1 / 8) & (np.abs(across) * size <= along * size * np.tan(WEDGE) + 0.5)
    if near is not None:
        allowed &= np.abs(np.log(np.maximum(along * size, 1e-9) / near)) <= COUNT_SLACK
    top = (p == ndimage.maximum_filter(p, 5)) & allowed
    iy, ix = np.nonzero(top)
    order = np.argsort(-p[iy, ix])[:count]
    peaks = []
    highest = ndimage.maximum_filter(p, 5)
    for r, c in zip(iy[order], ix[order], strict=True):
        dy, dx = _vertex(p[r - 1 : r + 2, c]), _vertex(p[r, c - 1 : c + 2])
        x, y = float(fx[c] + dx * (fx[1] - fx[0])), float(fy[r] + dy * (fy[1] - fy[0]))
        r2, c2 = int(np.searchsorted(fy, 2 * y)), int(np.searchsorted(fx, 2 * x))
        double = highest[r2, c2] if 0 <= r2 < len(fy) and 0 <= c2 < len(fx) else 0.0
        tilt = np.arctan2(y, x) if axis == 0 else np.arctan2(-x, y)
        peaks.append(Peak(x, y, float(p[r, c] + HARMONIC * double), float(tilt)))
    if near is not None and not peaks:
        f = near / size
        peaks.append(Peak(f, 0.0, 1.0, 0.0) if axis == 0 else Peak(0.0, f, 1.0, 0.0))
    return peaks


def structure_rotation(luma: Array) -> float:
    """Rotation of the cloth against the image axes from edge directions alone (radians, clockwise, y down).

    The fourfold mean direction of the gradients: yarn borders and fibers of both systems; twist biases it by some
    degrees, so it only serves to rule out sheared choices of the lattice.
    """
    fine = max(1.0, min(luma.shape) / 320)
    gx = ndimage.gaussian_filter(luma, fine, order=(0, 1))
    gy = ndimage.gaussian_filter(luma, fine, order=(1, 0))
    energy = gx**2 + gy**2
    fourfold = (gx + 1j * gy) ** 4 / (energy + 0.1 * np.median(energy) + 1e-12)
    return float(np.angle(fourfold[10:-10, 10:-10].sum()) / 4)


def pair_prior(warp: Peak, weft: Peak, best: tuple[float, float], rotation: float) -> float:
    """Log prior (nats) that two peaks are the two yarn systems: strong, nearly square, nearly upright.

    ``best`` holds the greatest strength among the peaks of each axis, ``rotation`` is :func:`structure_rotation`.
    """
    skew = warp.tilt - weft.tilt
    turn = (warp.tilt + weft.tilt) / 2
    ratio = np.log(np.hypot(warp.fx, warp.fy) / np.hypot(weft.fx, weft.fy))
    geometry = (skew / SKEW_SIGMA) ** 2 + (turn / TURN_SIGMA) ** 2 + ((turn - rotation) / STRUCTURE_SIGMA) ** 2
    strength = np.log(warp.strength / best[0]) + np.log(weft.strength / best[1])
    return float(-0.5 * geometry - 0.5 * (ratio / 0.6) ** 2 + STRENGTH_WEIGHT * strength)


def _vertex(v: Array) -> float:
    """Offset of the maximum of the parabola through three samples around a peak, in samples."""
    curve = v[0] - 2 * v[1] + v[2]
    return float(np.clip(0.5 * (v[0] - v[2]) / curve, -0.5, 0.5)) if curve < 0 else 0.0
