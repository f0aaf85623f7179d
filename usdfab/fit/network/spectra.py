"""What repeats in a picture of cloth, free of its scale: spectra along both axes, and of the lattice of crossings.

In a regular weave each yarn system repeats at its own frequency, near an image axis. Along a logarithmic axis of
frequencies another count is a mere shift. Once both frequencies are known the picture is resampled so that a crossing
is a unit square; its spectrum then shows the weave: plain at (1/2, 1/2), a twill over three at (1/3, 1/3), and so on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.fit.analysis.features import extract, normalise
from usdfab.fit.network.turns import Turn

Floats = NDArray[np.float64]

BINS = 96
LOW, HIGH = 3.0, 56.0
"""Yarns across the picture at the first and the last bin."""

FREQUENCIES = np.exp(np.linspace(np.log(LOW), np.log(HIGH), BINS))
"""Cycles per picture of the bins."""

BIN_WIDTH = float(np.log(HIGH / LOW) / (BINS - 1))
"""Of a bin, in log frequency."""

_TILTS = np.radians(np.linspace(-8.0, 8.0, 9))
"""Angles between a yarn frequency and its axis that are looked along."""

STEPS = 16
"""Samples of a lattice spectrum per cycle per crossing; it is computed twice as finely, and the larger kept."""

HINT_TRUST = 0.04
"""Relative deviation of the counts about which frequencies are refined."""

LATTICE_SHAPE = (3, STEPS + 1, 2 * STEPS + 2)
LATTICE_SIZE = int(np.prod(LATTICE_SHAPE))
_SHARE = 0.92
"""Part of the picture along each side that is resampled: a turned lattice must not leave it."""

_RECTIFIED = 192


@dataclass(frozen=True)
class Frequency:
    """A yarn system's frequency: ``cycles`` per picture across it, ``tilt`` of its direction to the axis in radians.

    The axis is x for the warp and y, upwards, for the weft; tilts are positive counter-clockwise as seen.
    """

    cycles: float
    tilt: float

    def turned(self, turn: Turn) -> Frequency:
        """The same system's after the picture was turned (where it may be the other system)."""
        return Frequency(self.cycles, -self.tilt if turn.mirrored else self.tilt)


def turned_maps(maps: Floats, turn: Turn) -> Floats:
    """Maps (C, H, W) of a turned picture from those of the picture, but for the sign of the orientation."""
    return np.ascontiguousarray(turn.picture(maps.transpose(1, 2, 0)).transpose(2, 0, 1))


def texture_maps(linear: NDArray) -> Floats:
    """(3, H, W) luminance, fiber orientation and edge energy of a linear picture (H, W, 3), slow parts removed."""
    found = extract(np.asarray(linear, dtype=np.float64))
    sigma = min(found.luma.shape) / 8
    return np.stack([found.luma, normalise(found.orientation, sigma), found.energy])


def axis_spectra(maps: Floats) -> Floats:
    """(2, 3, BINS) log power of (3, N, N) maps along x and y at ``FREQUENCIES``, the mean over the bins removed."""
    return np.stack([_level(np.log(_wedge(m, FREQUENCIES, _TILTS).max(axis=2) + 1e-9)) for m in _both_ways(maps)])


def refined(maps: Floats, counts: tuple[float, float]) -> tuple[Frequency, Frequency]:
    """The likeliest frequencies within a tenth of the ``counts`` of warp and weft in (3, N, N) maps.

    Where few yarns are seen peaks are wide and lean on each other: ``counts`` are taken to be right within
    ``HINT_TRUST``, which weighs more there.
    """
    tilts = np.radians(np.linspace(-9.0, 9.0, 19))
    found = []
    for sign, turned, count in zip((1.0, -1.0), _both_ways(maps), counts, strict=True):
        shares = np.linspace(0.9, 1.1, 21)
        cycles = count * shares
        power = _wedge(turned, cycles, tilts)
        total = (power / (power.mean(axis=(1, 2), keepdims=True) + 1e-12)).sum(axis=0)
        total *= np.exp(-0.5 * (np.log(shares) / HINT_TRUST) ** 2)[:, None]
        row, column = np.unravel_index(int(total.argmax()), total.shape)
        # Rows run down, so along x a positive slope of the frequency is clockwise.
        found.append(Frequency(_vertex(cycles, total[:, column], int(row)), -sign * float(tilts[column])))
    return found[0], found[1]


def to_lattice(size: int, warp: Frequency, weft: Frequency) -> Floats:
    """(2, 2) that maps crossings (u to the right, v upwards) to pixels (x to the right, y upwards) in a picture.

    ``size``: pixels on a side of the picture that the frequencies belong to.
    """
    # Rows of the matrix: directions of both frequencies, x to the right and y up, in yarns per pixel.
    a = warp.cycles / size * np.array([1.0, np.tan(warp.tilt)])
    b = weft.cycles / size * np.array([-np.tan(weft.tilt), 1.0])
    return np.asarray(np.linalg.inv(np.stack([a, b])))


def lattice_spectrum(maps: Floats, warp: Frequency, weft: Frequency) -> Floats:
    """``LATTICE_SHAPE`` log power of (3, N, N) maps at u, v cycles per crossing: u from 0 to 1, v from -1 to 1.

    u counts warp yarns to the right, v weft yarns upwards.
    """
    size = maps.shape[-1]
    back = to_lattice(size, warp, weft)
    yarns = np.array([warp.cycles, weft.cycles]) * _SHARE
    places = (np.arange(_RECTIFIED) + 0.5) / _RECTIFIED - 0.5
    u, v = np.meshgrid(places * yarns[0], places * yarns[1])
    x, y = np.tensordot(back, np.stack([u, v]), axes=1)
    middle = 0.5 * (size - 1)
    flat = [ndimage.map_coordinates(m, [middle - y, middle + x], order=1, mode="reflect") for m in maps]
    window = np.hanning(_RECTIFIED)
    upright = np.stack(flat) * (window[:, None] * window)
    fine = np.arange(2 * STEPS + 2) / (2 * STEPS)
    both = np.r_[-(fine[::-1] + fine[1]), fine]
    along = np.exp(-2j * np.pi * np.outer(places * yarns[0], fine))
    up = np.exp(-2j * np.pi * np.outer(places * yarns[1], both))
    power = np.abs(up.T @ (upright @ along)) ** 2
    power = power.transpose(0, 2, 1)
    pooled = power.reshape(3, STEPS + 1, 2, 2 * STEPS + 2, 2).max(axis=(2, 4))
    share = pooled / (pooled.sum(axis=(1, 2), keepdims=True) + 1e-12)
    return np.log(share + 1e-5)


def _both_ways(maps: Floats) -> tuple[Floats, Floats]:
    """Windowed maps for the x axis, and transposed for the y axis."""
    window = np.hanning(maps.shape[-1])
    windowed = maps * (window[:, None] * window)
    return windowed, windowed.transpose(0, 2, 1)


def _wedge(maps: Floats, cycles: Floats, tilts: Floats) -> Floats:
    """(3, F, T) power of (3, N, N) maps at ``cycles`` (F,) along their last axis and slopes ``tan(tilts)`` (T,)."""
    along, across = _waves(maps.shape[-1], tuple(cycles.tolist()), tuple(tilts.tolist()))
    # As one matrix product for each frequency: (F, C, N) @ (F, N, T).
    return (np.abs((maps @ along).transpose(2, 0, 1) @ across) ** 2).transpose(1, 0, 2)


@lru_cache(maxsize=4)
def _waves(size: int, cycles: tuple[float, ...], tilts: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Conjugate waves along the last axis, (N, F), and across it, (F, N, T)."""
    places = (np.arange(size) + 0.5) / size - 0.5
    frequencies = np.asarray(cycles)
    slopes = frequencies[:, None, None] * np.tan(np.asarray(tilts))
    return np.exp(-2j * np.pi * np.outer(places, frequencies)), np.exp(-2j * np.pi * places[:, None] * slopes)


def _level(values: Floats) -> Floats:
    return values - values.mean(axis=-1, keepdims=True)


def _vertex(places: Floats, values: Floats, k: int) -> float:
    """Where the parabola through three equally spaced samples about a maximum is highest."""
    if not 0 < k < len(values) - 1:
        return float(places[k])
    left, middle, right = values[k - 1 : k + 2]
    curve = left - 2.0 * middle + right
    offset = float(np.clip(0.5 * (left - right) / curve, -0.5, 0.5)) if curve < 0 else 0.0
    return float(places[k] + offset * (places[1] - places[0]))
