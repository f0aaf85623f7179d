"""Fireflies taken out of a picture without loss of light: what a pixel has too much is spread around it.

A few paths carry much light through narrow lobes. Means of a picture are right with them, statistics of its texture are
not: a single such pixel is brighter than all others, and a loss that compresses highlights loses its light.
Whether a path is found by this pixel or its neighbour is chance, so its light may as well be shared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter

Floats = NDArray[np.float64]

LIMIT = 3.0
"""Times the brightness around it that a pixel keeps."""

WINDOW = 5
"""Side in pixels of the window whose median is the brightness around a pixel."""

SPREAD = 4.0
"""Standard deviation in pixels of how far the rest is spread."""


@dataclass(frozen=True, eq=False)
class Spread:
    """A picture's fireflies spread: a linear map, with ``kept`` as it is for this picture.

    Parameters
    ----------
    kept: (H, W, 1)
        Part of each pixel that stays in its place.
    """

    kept: Floats

    @classmethod
    def of(cls, image: Floats) -> Spread:
        """For a picture (H, W, 3)."""
        brightness = image.mean(axis=-1)
        around = gaussian_filter(median_filter(brightness, WINDOW, mode="mirror"), 1.0)
        excess = brightness > LIMIT * np.maximum(around, 0.0)
        kept = np.ones_like(brightness)
        kept[excess] = LIMIT * np.maximum(around, 0.0)[excess] / brightness[excess]
        return cls(kept[..., None])

    @property
    def share(self) -> float:
        """Part of the pixels that give light away."""
        return float((self.kept < 1.0).mean())

    def __call__(self, image: Floats) -> Floats:
        """The picture (H, W, 3) with the same sum."""
        stays = self.kept * image
        return stays + _blurred(image - stays)

    def transposed(self, adjoint: Floats) -> Floats:
        """The derivative by a picture from that by the picture with its fireflies spread."""
        return self.kept * adjoint + (1.0 - self.kept) * _blurred(adjoint)


def _blurred(image: Floats) -> Floats:
    # `reflect` repeats the border pixel, which makes the blur its own transpose and keeps the sum.
    return gaussian_filter(image, (SPREAD, SPREAD, 0.0), mode="reflect")
