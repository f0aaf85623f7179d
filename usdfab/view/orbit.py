"""Moving a camera about what it looks at: turn, zoom, pan. NumPy only."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEEPEST = math.radians(89.0)
"""Angle between the line of sight and the horizon up to which a camera is tilted."""


@dataclass(frozen=True, eq=False)
class Orbit:
    """A camera that looks along its -z, y up, and the place about which it turns.

    Parameters
    ----------
    to_world: (4, 4)
        Rigid, camera space to world.
    target: (3,)
        Metres.
    up: (3,)
        Unit axis of turns to the side.
    """

    to_world: Floats
    target: Floats
    up: Floats

    def turned(self, azimuth: float, elevation: float) -> Orbit:
        """Moved about the target by degrees: to the right, and upwards, at most to nearly straight above."""
        side = self.to_world[:3, 0]
        back = self.to_world[:3, 2]
        now = math.asin(float(np.clip(back @ self.up, -1.0, 1.0)))
        wanted = float(np.clip(now + math.radians(elevation), -STEEPEST, STEEPEST))
        # A camera that starts beyond the limit, such as one straight above, is not thrown back to it.
        rise = wanted - now if (wanted - now) * elevation > 0.0 else 0.0
        turn = _rotation(self.up, math.radians(azimuth)) @ _rotation(side, -rise)
        moved = np.eye(4)
        moved[:3, :3] = turn @ self.to_world[:3, :3]
        moved[:3, 3] = self.target + turn @ (self.to_world[:3, 3] - self.target)
        return replace(self, to_world=moved)

    def zoomed(self, factor: float) -> Orbit:
        """Nearer to the target for factors above 1, so that it appears larger by that."""
        moved = self.to_world.copy()
        moved[:3, 3] = self.target + (self.to_world[:3, 3] - self.target) / factor
        return replace(self, to_world=moved)

    def panned(self, right: float, up: float, tan_half: Floats) -> Orbit:
        """What is at the target's distance moves by fractions of the picture's width and height."""
        distance = abs(float((self.target - self.to_world[:3, 3]) @ self.to_world[:3, 2]))
        width, height = 2.0 * distance * np.asarray(tan_half)
        shift = -right * width * self.to_world[:3, 0] - up * height * self.to_world[:3, 1]
        moved = self.to_world.copy()
        moved[:3, 3] += shift
        return replace(self, to_world=moved, target=self.target + shift)


def fitted_tangents(tan_half: Floats, width: int, height: int) -> Floats:
    """Tangents (2,) of a picture's half angles that shows no less than a camera with ``tan_half`` does."""
    tan_x, tan_y = (float(t) for t in tan_half)
    aspect = width / height
    return np.array([max(tan_x, tan_y * aspect), max(tan_x / aspect, tan_y)])


def _rotation(axis: Floats, angle: float) -> Floats:
    """Rodrigues' formula: (3, 3) about a unit axis, counter-clockwise."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
