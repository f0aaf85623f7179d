"""FLIP: how different two pictures look to a person who flips between them.

Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom, Fairchild, "FLIP: A Difference Evaluator for Alternating Images",
2020; the low-dynamic-range version, from the publication. Section numbers below are the paper's.

A pixel's error combines a colour difference (after blurring by what the eye cannot resolve, in a space where large
differences count right) and a feature difference (edges and points that only one of the pictures has).
"""

from __future__ import annotations

import math

import numpy as np
import scipy  # its parts are loaded when they are first used
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError

Floats = NDArray[np.float64]

PIXELS_PER_DEGREE = 67.0
"""A 0.7 m wide screen of 3840 pixels seen from 0.7 m (4.1)."""

# Contrast sensitivity as sums of two Gaussians, (a1, b1, a2, b2) for luminance, red-green, blue-yellow (table 1).
_SENSITIVITY = ((1.0, 0.0047, 0.0, 1e-5), (1.0, 0.0053, 0.0, 1e-5), (34.1, 0.04, 13.5, 0.025))
_COLOR_POWER, _COLOR_KNEE, _KNEE_VALUE = 0.7, 0.4, 0.95  # q_c, p_c, p_t (4.1.3)
_FEATURE_WIDTH, _FEATURE_POWER = 0.082, 0.5  # w in degrees, q_f (4.2)

_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)  # linear sRGB, exact
_FROM_XYZ = np.linalg.inv(_TO_XYZ)
_WHITE = _TO_XYZ.sum(axis=1)


def flip_map(test: ArrayLike, reference: ArrayLike, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Floats:
    """(H, W) errors in [0, 1]. Both pictures (H, W, 3) are linear Rec. 709; values are clipped to [0, 1].

    Raises
    ------
    UsdfabError
        For pictures of different or other shapes.
    """
    a, b = (np.clip(np.asarray(image, dtype=np.float64), 0.0, 1.0) for image in (test, reference))
    if a.shape != b.shape or a.ndim != 3 or a.shape[-1] != 3 or a.size == 0:
        raise UsdfabError(f"images of shape {a.shape} and {b.shape} cannot be compared by FLIP")
    opponents = [_opponent(image) for image in (a, b)]
    filters = [_sensitivity_filters(channel, pixels_per_degree) for channel in _SENSITIVITY]
    colors = [
        _hunt(_lab(_seen(np.stack([_filtered(o[..., c], filters[c]) for c in range(3)], axis=-1)))) for o in opponents
    ]
    color = _color_error(_hyab(colors[0], colors[1]))
    feature = _feature_error(_lightness(opponents[0]), _lightness(opponents[1]), pixels_per_degree)
    return color ** (1.0 - feature)


def flip(test: ArrayLike, reference: ArrayLike, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """Mean of ``flip_map``."""
    return float(np.mean(flip_map(test, reference, pixels_per_degree)))


def _opponent(linear: Floats) -> Floats:
    """Y Cx Cz: CIELAB's opponents without its cube root."""
    x, y, z = np.moveaxis(linear @ _TO_XYZ.T / _WHITE, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _lightness(opponent: Floats) -> Floats:
    """Y of 0 to 1."""
    return (opponent[..., 0] + 16.0) / 116.0


def _seen(opponent: Floats) -> Floats:
    """Back to linear RGB, clipped."""
    y = _lightness(opponent)
    xyz = np.stack([y + opponent[..., 1] / 500.0, y, y - opponent[..., 2] / 200.0], axis=-1) * _WHITE
    return np.clip(xyz @ _FROM_XYZ.T, 0.0, 1.0)


def _lab(linear: Floats) -> Floats:
    ratio = linear @ _TO_XYZ.T / _WHITE
    d = 6.0 / 29.0
    f = np.where(ratio > d**3, np.cbrt(ratio), ratio / (3.0 * d * d) + 4.0 / 29.0)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _hunt(lab: Floats) -> Floats:
    """Colourfulness grows with lightness (4.1.2)."""
    lightness = lab[..., :1]
    return np.concatenate([lightness, 0.01 * lightness * lab[..., 1:]], axis=-1)


def _hyab(a: Floats, b: Floats) -> Floats:
    d = a - b
    return np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2])


def _color_error(hyab: Floats) -> Floats:
    green, blue = (_hunt(_lab(np.array(c))) for c in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    most = float(_hyab(green, blue)) ** _COLOR_POWER
    power, knee = hyab**_COLOR_POWER, _COLOR_KNEE * most
    high = _KNEE_VALUE + (power - knee) / (most - knee) * (1.0 - _KNEE_VALUE)
    return np.where(power < knee, _KNEE_VALUE / knee * power, high)


def _sensitivity_filters(channel: tuple[float, float, float, float], ppd: float) -> list[tuple[float, Floats]]:
    """Separable parts (weight, 1-d kernel) of a channel's filter; all weights sum to 1."""
    widest = max(b for _, b1, _, b2 in _SENSITIVITY for b in (b1, b2))
    radius = math.ceil(3.0 * math.sqrt(widest / (2.0 * math.pi**2)) * ppd)
    x = np.arange(-radius, radius + 1) / ppd
    parts = []
    for a, b in ((channel[0], channel[1]), (channel[2], channel[3])):
        if a > 0.0:
            kernel = np.exp(-(math.pi**2) * x**2 / b)
            parts.append((a * math.sqrt(math.pi / b) * kernel.sum() ** 2, kernel / kernel.sum()))
    total = sum(weight for weight, _ in parts)
    return [(weight / total, kernel) for weight, kernel in parts]


def _filtered(image: Floats, parts: list[tuple[float, Floats]]) -> Floats:
    result = np.zeros_like(image)
    for weight, kernel in parts:
        result += weight * _separable(image, kernel, kernel)
    return result


def _separable(image: Floats, along_x: Floats, along_y: Floats) -> Floats:
    rows = scipy.ndimage.correlate1d(image, along_x, axis=1, mode="nearest")
    return scipy.ndimage.correlate1d(rows, along_y, axis=0, mode="nearest")


def _feature_error(a: Floats, b: Floats, ppd: float) -> Floats:
    """Differences of edges and points (4.2)."""
    deviation = 0.5 * _FEATURE_WIDTH * ppd
    radius = math.ceil(3.0 * deviation)
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    gauss = np.exp(-(x**2) / (2.0 * deviation**2))
    smooth = gauss / gauss.sum()
    edge = _balanced(-x * gauss)
    point = _balanced((x**2 / deviation**2 - 1.0) * gauss)
    differences = []
    for kernel in (edge, point):
        strength = [np.hypot(_separable(i, kernel, smooth), _separable(i, smooth, kernel)) for i in (a, b)]
        differences.append(np.abs(strength[0] - strength[1]))
    return (np.maximum(*differences) / math.sqrt(2.0)) ** _FEATURE_POWER


def _balanced(kernel: Floats) -> Floats:
    """Positive weights summing to 1, negative ones to -1."""
    up, down = np.maximum(kernel, 0.0), np.minimum(kernel, 0.0)
    return up / up.sum() - down / down.sum()
