"""The point model of ``surface_model`` for kernels: Numba functions of scalars.

A pair of directions enters through its five scalar products with the frame, ``ci = |wi.n|``, ``co = |wo.n|``,
``ti = wi.t``, ``to = wo.t``, ``io = wi.wo``, since nothing else matters to a flake. None allocates and none checks.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from usdfab.scattering.surface_model import OPTICAL_DEPTH

_DEPTH = OPTICAL_DEPTH
_INV_PI = 1.0 / math.pi

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
    "forceinline": True,
}


@njit(**_OPTIONS)
def flake_area(t, alpha):
    """sigma of a unit direction whose part along the fiber is ``t``."""
    return math.sqrt(max(1.0 - (1.0 - alpha * alpha) * t * t, 0.0))


@njit(**_OPTIONS)
def flake_density_of_pair(ti, to, io, alpha):
    """D at the half vector of two directions."""
    length2 = 2.0 + 2.0 * io
    along = ti + to
    # Straight through: the flakes that do it stand across the fiber.
    along2 = along * along / length2 if length2 > 1e-12 else 0.0
    q = 1.0 + (1.0 / (alpha * alpha) - 1.0) * along2
    return _INV_PI / (alpha * q * q)


@njit(**_OPTIONS)
def flake_reflection(ci, co, ti, to, io, alpha):
    """``D G / 4`` of reflection: the specular term of eq. 1 times both cosines."""
    ci, co = max(ci, 1e-7), max(co, 1e-7)
    total = flake_area(ti, alpha) / ci + flake_area(to, alpha) / co
    return 0.25 * flake_density_of_pair(ti, to, io, alpha) * (1.0 - math.exp(-_DEPTH * total)) / total


@njit(**_OPTIONS)
def flake_transmission(ci, co, ti, to, io, alpha):
    """``D G / 4`` of transmission."""
    li = flake_area(ti, alpha) / max(ci, 1e-7)
    lo = flake_area(to, alpha) / max(co, 1e-7)
    gap = abs(li - lo)
    slope = (1.0 - math.exp(-_DEPTH * gap)) / gap if gap > 1e-6 else _DEPTH
    return 0.25 * flake_density_of_pair(ti, to, io, alpha) * math.exp(-_DEPTH * min(li, lo)) * slope
