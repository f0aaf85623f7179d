"""Functions of vectors of sixteen floats: powers, logarithms, products."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from usdfab.neural.simd import (
    bits_to_integers,
    floor,
    integers_to_bits,
    least,
    most,
    root,
    spread,
    to_floats,
    to_integers,
    where,
)

INLINE: dict[str, Any] = {"error_model": "numpy", "forceinline": True}

_LOG2_E, _LN2 = math.log2(math.e), math.log(2.0)
_E2, _E3, _E4, _E5, _E6, _E7 = (_LN2**k / math.factorial(k) for k in range(2, 8))
_L0, _L1, _L2, _L3, _L4 = (2.0 / (_LN2 * (2 * k + 1)) for k in range(5))


@njit(**INLINE)
def exp2(x):
    """2^x for -126 < x < 127, to about 2e-7."""
    x = least(most(x, -126.0), 126.999)
    whole = floor(x + 0.5)
    f = x - whole
    power = 1.0 + f * (_LN2 + f * (_E2 + f * (_E3 + f * (_E4 + f * (_E5 + f * (_E6 + f * _E7))))))
    return power * integers_to_bits((to_integers(whole) + 127) << 23)


@njit(**INLINE)
def exp(x):
    """e^x, to about 3e-7 for |x| < 10."""
    return exp2(x * _LOG2_E)


@njit(**INLINE)
def log2(x):
    """Logarithm to base 2 of normal positive floats, to about 3e-7 absolute near 1."""
    bits = bits_to_integers(x)
    # The mantissa in [1/sqrt 2, sqrt 2): log2 m = 2 artanh((m - 1) / (m + 1)) / ln 2.
    exponent = (bits - 0x3F3504F3) >> 23
    m = integers_to_bits(bits - (exponent << 23))
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    return to_floats(exponent) + s * (_L0 + q * (_L1 + q * (_L2 + q * (_L3 + q * _L4))))


@njit(**INLINE)
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(**INLINE)
def inverse_length(x, y, z):
    """1 over the length of a vector; finite for 0."""
    return 1.0 / root(most(x * x + y * y + z * z, 1e-30))


@njit(**INLINE)
def fraction(x):
    """x - floor(x), in [0, 1)."""
    f = x - floor(x)
    return where(f >= 1.0, spread(0.0), f)
