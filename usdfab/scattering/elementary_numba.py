"""Elementary functions that Numba inlines: least-maximum polynomials, two to five times as fast as the C library's.

Errors are far below what the scattering models can be trusted with; each function states its own. NaN in, NaN out; what
lies outside a stated range is the caller's mistake.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

__all__ = ["INLINED", "fast_asin", "fast_atan2", "fast_cos_half_turn", "fast_exp", "fast_log", "fast_sincos"]

# No `nnan`, no `ninf`: guards against what is not finite must stay. No division check: none of the divisors can be
# zero. Inlined by force, since LLVM finds the functions that use this too large and would pass their tuples through
# memory: a third of the time.
INLINED: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
    "forceinline": True,
}
"""Options of small functions of scalars and tuples."""

_LN2 = 0.6931471805599453
_HALF_PI = 0.5 * math.pi
_MANTISSA = 0x000FFFFFFFFFFFFF
_EXPONENT_OF_1 = 0x3FF0000000000000


@njit(**INLINED)
def fast_exp(x):
    """e^x for x <= 0: relative error 5e-11, exactly 1 at 0, 1e-304 below -700."""
    x = max(x, -700.0)
    k = math.floor(x * 1.4426950408889634 + 0.5)
    r = x - k * _LN2
    y = 0.0013945909115767692 + r * 0.00019767657325823942
    y = 0.04166627239486353 + r * (0.008333568992028537 + r * y)
    y = 0.5000000077192124 + r * (0.16666665162901595 + r * y)
    y = 1.0 + r * (1.0000000002087592 + r * y)
    # 2^k by its bits.
    return y * np.int64((np.int64(k) + 1023) << 52).view(np.float64)


@njit(**INLINED)
def fast_log(x):
    """Natural logarithm of a normal number above 0: error 2e-12 absolute or 1e-11 of the value, exactly 0 at 1.

    x = 2^k m with m in [0.7, 1.4]; log m = 2 artanh(s), s = (m - 1) / (m + 1).
    """
    bits = np.float64(x).view(np.int64)
    k = (bits >> 52) - 1023
    m = np.int64((bits & _MANTISSA) | _EXPONENT_OF_1).view(np.float64)
    if m > 1.4142135623730951:
        m, k = 0.5 * m, k + 1
    s = (m - 1.0) / (m + 1.0)
    t = s * s
    y = 0.28534960384289815 + t * 0.2361793102810937
    y = 2.0000000000083977 + t * (0.6666666523888529 + t * (0.400003862779008 + t * y))
    return k * _LN2 + s * y


@njit(**INLINED)
def fast_asin(x):
    """Arc sine on [-1, 1]: pi/2 - sqrt(1 - |x|) P(|x|), odd; absolute error 3e-10, exact at 0 and +-1."""
    a = abs(x)
    y = 0.0028579613880584196 + a * -0.00048366825434151853
    y = 0.01515279864710833 + a * (-0.008048713237337947 + a * y)
    y = 0.033419934466777115 + a * (-0.023165743661482153 + a * y)
    y = 0.0890466016949547 + a * (-0.05076014784747677 + a * y)
    y = _HALF_PI + a * (-0.21460179349927908 + a * y)
    return math.copysign(_HALF_PI - math.sqrt(1.0 - a) * y, x)


@njit(**INLINED)
def fast_atan2(y, x):
    """Angle of (x, y) in [-pi, pi]: absolute error 2e-10; 0 or pi for (0, 0), as the signs say."""
    a, b = abs(x), abs(y)
    q = min(a, b) / max(a, b, 5e-324)
    t = q * q
    p = -0.006394791584938274 + t * 0.0009375633484261502
    p = -0.042088151817438024 + t * (0.020467880307898128 + t * p)
    p = -0.08713861418750292 + t * (0.06541381203169003 + t * p)
    p = -0.14274432158195519 + t * (0.11028651324531988 + t * p)
    p = -0.33333302089640565 + t * (0.19999129800000073 + t * p)
    angle = q * (0.9999999966724501 + t * p)
    if b > a:
        angle = _HALF_PI - angle
    if math.copysign(1.0, x) < 0.0:
        angle = math.pi - angle
    return math.copysign(angle, y)


@njit(**INLINED)
def fast_sincos(x):
    """(sin x, cos x) for |x| up to some thousand: absolute error 1e-13 near 0, growing by 1e-16 |x|."""
    k = math.floor(x * (2.0 / math.pi) + 0.5)
    r = x - k * _HALF_PI
    t = r * r
    s = -0.00019841260569592841 + t * (2.7554834229693372e-06 + t * -2.4730995055868066e-08)
    s = r * (0.9999999999999691 + t * (-0.1666666666653333 + t * (0.00833333331642288 + t * s)))
    c = -0.0013888880396967888 + t * (2.4798927276273223e-05 + t * -2.717346085057761e-07)
    c = 0.9999999999999445 + t * (-0.4999999999935199 + t * (0.041666666543997026 + t * c))
    turn = np.int64(k) & 3
    if turn & 1:
        s, c = c, -s
    if turn & 2:
        s, c = -s, -c
    return s, c


@njit(**INLINED)
def fast_cos_half_turn(u):
    """cos(pi u) on [0, 1] as sin(pi (1/2 - u)): absolute error 2e-11."""
    z = 0.5 - u
    x = z * z
    y = 0.08203123027860795 + x * -0.007000500565147764
    y = 2.5501627947246344 + x * (-0.5992474049377746 + x * y)
    return z * (3.1415926532437544 + x * (-5.167712741221726 + x * y))
