"""Colour: the exact sRGB transfer function and luminance. Everything else in usdfab is linear Rec. 709.

References: IEC 61966-2-1:1999 (sRGB), ITU-R BT.709-6 (luminance weights).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear Rec. 709 red, green, blue in the luminance Y (BT.709-6, item 3.2)."""


def srgb_to_linear(encoded: ArrayLike) -> NDArray[Any]:
    """Decode sRGB values, any shape, 0 to 1, to linear light of the same shape.

    Values outside [0, 1] follow the same curve, mirrored at 0. float32 in, float32 out; else float64.
    """
    x = _floating(encoded)
    size = np.abs(x)
    low, high = size / x.dtype.type(12.92), ((size + x.dtype.type(0.055)) / x.dtype.type(1.055)) ** x.dtype.type(2.4)
    return np.copysign(np.where(size <= 0.04045, low, high), x)


def linear_to_srgb(linear: ArrayLike) -> NDArray[Any]:
    """Encode linear light, any shape, to sRGB values of the same shape; the inverse of ``srgb_to_linear``."""
    x = _floating(linear)
    size = np.abs(x)
    low = size * x.dtype.type(12.92)
    high = x.dtype.type(1.055) * size ** x.dtype.type(1 / 2.4) - x.dtype.type(0.055)
    return np.copysign(np.where(size <= 0.0031308, low, high), x)


def luminance(linear: ArrayLike) -> NDArray[Any]:
    """Luminance Y of linear Rec. 709 colours (..., 3); shape (...)."""
    x = _floating(linear)
    return x @ np.asarray(LUMINANCE, dtype=x.dtype)


@cache
def decoding_table(bits: int) -> NDArray[np.float32]:
    """Linear light of every sRGB code of 8 or 16 bits, (2^bits,)."""
    codes = np.arange(2**bits) / (2**bits - 1)
    table = srgb_to_linear(codes).astype(np.float32)
    table.setflags(write=False)
    return table


def _floating(values: ArrayLike) -> NDArray[Any]:
    x = np.asarray(values)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float64)
