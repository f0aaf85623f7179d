"""What light does that goes straight through a fiber, the TT lobe alone, for Numba; see ``fiber_numba``."""

from __future__ import annotations

import math

from numba import njit

from usdfab.scattering.elementary_numba import INLINED, fast_asin
from usdfab.scattering.fiber_numba import (
    _ETA2_MINUS_1,
    _INV_V,
    _M_SCALE,
    _S,
    _azimuthal,
    _longitudinal,
)

__all__ = [
    "attenuation_tt",
    "azimuth_scale",
    "eval_fiber_tt",
    "longitudinal_tt",
    "middle_tt",
    "modified_eta2",
    "turn_tt",
    "turn_tt_slope",
]


@njit(**INLINED)
def azimuth_scale(p):
    """Scale of the logistic D of a material (FIBER_SIZE,), rad."""
    return p[_S]


@njit(**INLINED)
def modified_eta2(p, cos_to):
    """eta'^2 = (eta^2 - sin^2 theta_o) / cos^2 theta_o, in the plane across the fiber (Marschner et al. 2003)."""
    return 1.0 + p[_ETA2_MINUS_1] / (cos_to * cos_to)


@njit(**INLINED)
def turn_tt(h, eta2):
    """2 gamma_t - 2 gamma_o, rad: how far light turns that goes through a fiber at offset h; ``eta2`` is eta'^2."""
    return 2.0 * (fast_asin(h / math.sqrt(eta2)) - fast_asin(h))


@njit(**INLINED)
def turn_tt_slope(h, eta2):
    """Derivative of ``turn_tt`` by h, |h| < 1; negative."""
    return 2.0 / math.sqrt(eta2 - h * h) - 2.0 / math.sqrt(1.0 - h * h)


@njit(**INLINED)
def middle_tt(prep):
    """Phi of TT, rad: the azimuth phi_i - phi_o of the middle of the lobe, at a vertex of ``prepare_fiber``."""
    return prep[9]


@njit(**INLINED)
def attenuation_tt(prep):
    """A of TT in RGB, at a vertex of ``prepare_fiber``."""
    return prep[12], prep[13], prep[14]


@njit(**INLINED)
def longitudinal_tt(p, prep, sin_ti, cos_ti):
    """M of TT, as in ``eval_fiber``."""
    return _longitudinal(p[_M_SCALE + 1], p[_INV_V + 1], sin_ti, cos_ti, prep[2], prep[3])


@njit(**INLINED)
def eval_fiber_tt(p, prep, sin_ti, cos_ti, phi):
    """The part of ``eval_fiber`` that TT has: (fr, fg, fb)."""
    d = _azimuthal(p, phi - middle_tt(prep))
    if d > 0.0:
        d *= longitudinal_tt(p, prep, sin_ti, cos_ti)
    red, green, blue = attenuation_tt(prep)
    return d * red, d * green, d * blue
