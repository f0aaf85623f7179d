"""From scene-linear pixels to a picture for a screen: exposure and tone mapping. EXR files never go through here.

The result is linear light from 0 to 1, which ``write_image`` encodes as sRGB.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging.color import luminance

VIEWS = ("standard", "reinhard")
"""``standard``: clipped at 1, as ever. ``reinhard``: highlights roll off, ``REINHARD_WHITE`` becomes white."""

REINHARD_WHITE = 4.0
"""Luminance that becomes 1: two stops above diffuse white."""


def view_transform(pixels: ArrayLike, exposure: float = 0.0, view: str = "standard") -> NDArray[np.float32]:
    """Linear Rec. 709 pixels (..., 3), times 2^exposure, as linear light from 0 to 1 for a screen.

    ``reinhard`` scales a colour by the ratio of its luminances, ``L_d = L (1 + L / W^2) / (1 + L)``, which keeps its
    hue (Reinhard, Stark, Shirley, Ferwerda 2002, equation 4, on single pixels; W is ``REINHARD_WHITE``).

    Raises
    ------
    UsdfabError
        For an unknown view.
    """
    if view not in VIEWS:
        raise UsdfabError(f"there is no view '{view}'", place="--view", remedy=f"choose {' or '.join(VIEWS)}")
    scaled = np.asarray(pixels, dtype=np.float64) * 2.0**exposure
    if view == "reinhard":
        level = np.maximum(luminance(scaled), 0.0)[..., None]
        scaled = scaled * (1.0 + level / REINHARD_WHITE**2) / (1.0 + level)
    return np.clip(scaled, 0.0, 1.0).astype(np.float32)
