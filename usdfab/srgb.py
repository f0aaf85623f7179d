"""The exact sRGB transfer function (IEC 61966-2-1:1999), for any part of usdfab. All else is linear Rec. 709."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def srgb_to_linear(encoded: ArrayLike) -> NDArray[Any]:
    """Decode sRGB values, any shape, 0 to 1, to linear light of the same shape.

    Values outside [0, 1] follow the same curve, mirrored at 0. float32 in, float32 out; else float64.
    """
    x = floating(encoded)
    size = np.abs(x)
    low, high = size / x.dtype.type(12.92), ((size + x.dtype.type(0.055)) / x.dtype.type(1.055)) ** x.dtype.type(2.4)
    return np.copysign(np.where(size <= 0.04045, low, high), x)


def linear_to_srgb(linear: ArrayLike) -> NDArray[Any]:
    """Encode linear light, any shape, to sRGB values of the same shape; the inverse of ``srgb_to_linear``."""
    x = floating(linear)
    size = np.abs(x)
    low = size * x.dtype.type(12.92)
    high = x.dtype.type(1.055) * size ** x.dtype.type(1 / 2.4) - x.dtype.type(0.055)
    return np.copysign(np.where(size <= 0.0031308, low, high), x)


def floating(values: ArrayLike) -> NDArray[Any]:
    """``values`` as they are if float32 or float64, else as float64."""
    x = np.asarray(values)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float64)
