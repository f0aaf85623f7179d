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
        return self.segments(seen.segment[rows].astype(np.int64), seen.copy[rows], start)

    def segments(self, segment: NDArray[np.int64], copy: NDArray, start: NDArray[np.float64]) -> Segments:
        """The segments (N,) in copies (N, 2) of the patch, relative to ``start`` (N, 3) metres."""
        period = np.array(self.model.size)
        shift = np.zeros((len(segment), 3))
        shift[:, :2] = copy * period
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

    def beside(self, seen: Seen, start: NDArray[np.float64], direction: Tensor, rows: NDArray[np.int64]) -> Segments:
        """The segments of the fibers that the rays ``rows`` saw which lie nearest to other rays, from ``start``.

        From the segment that was seen, along the fiber, ``STEPS`` segments at most: where along a fiber one segment
        gives way to the next must not matter.
        """
        segment, copy = seen.segment[rows].astype(np.int64), seen.copy[rows].astype(np.int64)
        with torch.no_grad():
            for _ in range(STEPS):
                along = _cylinder(self.segments(segment, copy, start), direction)[3].numpy()
                on, back = along > 1.0, along < 0.0
                if not (on | back).any():
                    break
                copy = copy + on[:, None] * self.model.following_shift[segment]
                copy = copy + back[:, None] * self.model.preceding_shift[segment]
                segment = np.where(
                    on, self.model.following[segment], np.where(back, self.model.preceding[segment], segment)
                )
        return self.segments(segment, copy, start)


STEPS = 2
"""Segments along a fiber that are searched for the one beside a ray."""


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3) and (..., 3) to (...)."""
    return (a * b).sum(dim=-1)


def _cylinder(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As ``pass_by``, of the infinite cylinders; and where along the segments rays enter them or pass by, in [0, 1]."""
    chord = s.end - s.start
    length = torch.sqrt(dot(chord, chord) + _EPSILON)
    axis = chord / length[:, None]
    b = dot(direction, axis)
    sin2 = (1.0 - b * b).clamp_min(1e-6)
    middle = (dot(s.start, direction) - b * dot(s.start, axis)) / sin2
    half = s.radius / torch.sqrt(sin2)
    across = torch.linalg.cross(direction, axis, dim=-1)
    h = dot(s.start, across) / (torch.sqrt(sin2) * s.radius)
    entry = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + _EPSILON)
    return h, middle, half, (b * entry - dot(s.start, axis)) / length


def pass_by(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How rays pass segments, which are cylinders that end in spheres.

    Returns
    -------
    h: (N,)
        Signed distance of the ray from the axis, or where it meets the sphere at an end from its centre, in fiber
        radii: beyond -1 and 1 the ray misses.
    middle, half: (N,)
        The surface is at ``middle - half * sqrt(1 - h^2)`` along the ray.
    """
    h, middle, half, along = _cylinder(s, direction)
    # The two segments at a joint share its sphere, so that it does not matter which of them Embree names.
    past_end = along > 1.0
    center = torch.where(past_end[:, None], s.end, s.start)
    nearest = dot(center, direction)
    aside = center - nearest[:, None] * direction
    distance = torch.sqrt(dot(aside, aside) + _EPSILON) / s.radius
    inside = (along >= 0.0) & ~past_end
    return (
        torch.where(inside, h, torch.where(h < 0.0, -distance, distance)),
        torch.where(inside, middle, nearest),
        torch.where(inside, half, s.radius),
    )


class Meeting(NamedTuple):
    """Where rays enter fibers: distance along the ray (N,), unit tangent of the smooth fiber there (N, 3), offset h."""

    distance: Tensor
    tangent: Tensor
    h: Tensor


def meet(s: Segments, direction: Tensor) -> Meeting:
    """Where rays enter segments; rays that miss are taken at the side.

    ``direction`` (N, 3) unit vectors. The tangent is blended along the segment, so that it runs on smoothly in the next
    one, and h belongs to it: with the surface's normal projected across the tangent, as the tracer does.
    """
    h, middle, half = pass_by(s, direction)
    h = h.clamp(-1.0, 1.0)
    distance = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + _EPSILON)
    chord = s.end - s.start
    hit = distance[:, None] * direction
    u = (dot(hit - s.start, chord) / (dot(chord, chord) + _EPSILON)).clamp(0.0, 1.0)[:, None]
    tangent = (1.0 - u) * s.start_tangent + u * s.end_tangent
    tangent = tangent / torch.sqrt(dot(tangent, tangent) + _EPSILON)[:, None]
    normal = hit - (s.start + u * chord)
    normal = normal - dot(normal, tangent)[:, None] * tangent
    across = torch.linalg.cross(direction, tangent, dim=-1)
    scale = torch.sqrt(dot(across, across) * dot(normal, normal) + _EPSILON)
    return Meeting(distance, tangent, (-dot(normal, across) / scale).clamp(-1.0, 1.0))
