"""From metres to the units in which Mitsuba is exact enough for fibers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RAY_OFFSET = 9e-5
"""Mitsuba's rays start about this times (1 + |p|) off a surface at p, in its units."""


@dataclass(frozen=True, eq=False)
class Space:
    """Mitsuba's point is ``scale * (p - origin)``: ``scale`` units a metre, ``origin`` (3,) in the world.

    Fibers in metres would be far below Mitsuba's ray offset, and so would be fibers far from its origin.
    """

    scale: float
    origin: Floats

    def points(self, points: Floats) -> Floats:
        """(..., 3) in Mitsuba's units."""
        return self.scale * (points - self.origin)

    def matrix(self, matrix: Floats) -> Floats:
        """(4, 4) to-world of something whose own space is in Mitsuba's units already."""
        out = matrix.copy()
        out[:3, 3] = self.points(matrix[:3, 3])
        return out
