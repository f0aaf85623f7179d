"""Colour: the exact sRGB transfer function and luminance. Everything else in usdfab is linear Rec. 709.

References: IEC 61966-2-1:1999 (sRGB), ITU-R BT.709-6 (luminance weights).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.srgb import floating, linear_to_srgb as linear_to_srgb, srgb_to_linear as srgb_to_linear

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear Rec. 709 red, green, blue in the luminance Y (BT.709-6, item 3.2)."""


def luminance(linear: ArrayLike) -> NDArray[Any]:
    """Luminance Y of linear Rec. 709 colours (..., 3); shape (...)."""
    x = floating(linear)
    return x @ np.asarray(LUMINANCE, dtype=x.dtype)


@cache
def decoding_table(bits: int) -> NDArray[np.float32]:
    """Linear light of every sRGB code of 8 or 16 bits, (2^bits,)."""
    codes = np.arange(2**bits) / (2**bits - 1)
    table = srgb_to_linear(codes).astype(np.float32)
    table.setflags(write=False)
    return table
