"""Unevenness of yarns: how thickness and the sideways place vary along them.

Li et al. 2024 have yarns of one thickness, straight but for their crimp. Spun yarns are neither: their linear density
varies by 10 to 20 % (the CV of Uster's statistics), and they give way sideways to the yarns they cross. Both are
stationary random curves along the yarn with a standard deviation of 1, cubic B-splines over one draw for each cell, so
that they close over the patch and have the smoothness of the fibers' own curves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GAIN = math.sqrt(315.0 / 151.0)
"""Makes the variance 1, on average along the yarn: the squares of the B-spline's weights add up to 151 / 315."""

THINNEST = 0.3
"""No yarn is thinner than this part of its mean."""


def interpolated(knots: Floats, yarn: NDArray[np.int64], place: Floats) -> Floats:
    """The random curves of ``yarn`` at ``place`` cells along, periodic.

    Parameters
    ----------
    knots: (yarns, cells)
        Standard normal draws.
    yarn, place:
        Of shapes that broadcast against each other.
    """
    cells = knots.shape[1]
    first = np.floor(place).astype(np.int64)
    t = place - first
    weights = (
        (1.0 - t) ** 3 / 6.0,
        (3.0 * t**3 - 6.0 * t**2 + 4.0) / 6.0,
        (-3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0) / 6.0,
        t**3 / 6.0,
    )
    return GAIN * sum(w * knots[yarn, (first + k - 1) % cells] for k, w in enumerate(weights))


def highest(knots: Floats) -> Floats:
    """(yarns,) a bound of the curves' absolute values: B-splines stay within the hull of their knots."""
    return GAIN * np.abs(knots).max(axis=1)
