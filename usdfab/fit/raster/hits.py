"""Where a ray meets a fiber, as a differentiable function of the fiber's vertices.

All pixels of a picture are done at once: N rays, each with the segment that Embree found. Vertices are moved into the
frame of the ray's start in double precision; what follows is in ``dtype``. Lengths in units of ``scale`` metres, the
radius of a fiber, so that single precision has digits to spare.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.curves import CurveModel, Polylines
from usdfab.fit.raster.visibility import Seen

_EPSILON = 1e-12


class Segments(NamedTuple):
    """Straight pieces of fibers beside rays that start at the origin: ends and unit tangents (N, 3), radius (N,)."""

    start: Tensor
    end: Tensor
    start_tangent: Tensor
    end_tangent: Tensor
    radius: Tensor


@dataclass(frozen=True)
class Gatherer:
    """Looks up segments of a patch. ``scale`` metres are one unit."""

    model: CurveModel
    lines: Polylines
    scale: float
    dtype: torch.dtype

    def __call__(self, seen: Seen, start: NDArray[np.float64], rows: NDArray[np.int64]) -> Segments:
        """The segments that the rays ``rows`` saw, relative to ``start`` (N, 3) metres, one for each of them."""
        segment = seen.segment[rows].astype(np.int64)
        period = np.array(self.model.size)
        shift = np.zeros((len(rows), 3))
        shift[:, :2] = seen.copy[rows] * period
        on = shift.copy()
        on[:, :2] += self.model.following_shift[segment] * period
        first, second = torch.from_numpy(segment), torch.from_numpy(self.model.following[segment])
        points, tangents = self.lines.points, self.lines.tangents.to(self.dtype)
        radius = (self.lines.radius / self.scale).to(self.dtype)
        return Segments(
            ((points[first] + torch.from_numpy(shift - start)) / self.scale).to(self.dtype),
            ((points[second] + torch.from_numpy(on - start)) / self.scale).to(self.dtype),
            tangents[first],
            tangents[second],
            torch.where(torch.from_numpy(self.model.system[segment] == 0), radius[0], radius[1]),
        )


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3) and (..., 3) to (...)."""
    return (a * b).sum(dim=-1)


def offset(s: Segments, direction: Tensor) -> Tensor:
    """h: signed distance of the ray from the fiber's axis in fiber radii, (N,). Beyond -1 and 1 the ray misses."""
    across = torch.linalg.cross(direction, s.end - s.start, dim=-1)
    return dot(s.start, across) / (torch.sqrt(dot(across, across) + _EPSILON) * s.radius)


class Meeting(NamedTuple):
    """Where rays enter fibers: distance along the ray (N,), offset h (N,), place along the segment in [0, 1] (N,)."""

    distance: Tensor
    h: Tensor
    along: Tensor


def cylinder(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """h (N,), the distance along the ray at which it passes the axis, and how long a radius is along the ray."""
    axis = s.end - s.start
    axis = axis / torch.sqrt(dot(axis, axis) + _EPSILON)[:, None]
    b = dot(direction, axis)
    sin2 = (1.0 - b * b).clamp_min(1e-6)
    middle = (dot(s.start, direction) - b * dot(s.start, axis)) / sin2
    return offset(s, direction), middle, s.radius / torch.sqrt(sin2)


def meet(s: Segments, direction: Tensor) -> Meeting:
    """Where rays enter the infinite cylinders around segments; rays that miss are taken at the side.

    ``direction`` (N, 3) unit vectors.
    """
    h, middle, half = cylinder(s, direction)
    h = h.clamp(-1.0, 1.0)
    distance = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + _EPSILON)
    axis = s.end - s.start
    along = dot(distance[:, None] * direction - s.start, axis) / (dot(axis, axis) + _EPSILON)
    return Meeting(distance, h, along)


def tangent_at(s: Segments, along: Tensor) -> Tensor:
    """(N, 3) unit tangent of the smooth fiber at a place of the segment."""
    u = along.clamp(0.0, 1.0)[:, None]
    t = (1.0 - u) * s.start_tangent + u * s.end_tangent
    return t / torch.sqrt(dot(t, t) + _EPSILON)[:, None]
