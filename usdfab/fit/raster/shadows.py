"""Rims of shadows between neighbouring pixels of one fiber: the geometry behind ``edges``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.curves import Polylines, as_numpy
from usdfab.fit.raster.edges import Jumps, Pairs, crossing, crossing_slopes, inside, outside
from usdfab.fit.raster.hits import in_units
from usdfab.fit.raster.segments import (
    BLOCK,
    EPSILON,
    INLINE,
    SYSTEM,
    Floats,
    Geometry,
    add_to_ends,
    ends_of,
    pass_by,
    pass_by_slopes,
    same_fiber,
    settled,
)
from usdfab.fit.raster.visibility import Seen
from usdfab.tracer.intrinsics import ENTRY, borrow


def shadow_edges(
    geometry: Geometry,
    lines: Polylines,
    distance: Tensor,
    shines: Tensor,
    seen: Seen,
    shadow: Seen,
    lamp: Floats,
    pairs: Pairs,
    along_row: bool,
    reach: Floats | None = None,
) -> list[Jumps]:
    """Rims of one lamp's shadows between pixels of the same fiber, for ``edges.blended``.

    The jump function is h - 1 of the fiber that casts the shadow, along rays from what pixels see to the lamp.

    Parameters
    ----------
    distance: (N,)
        Of what the camera's rays meet.
    shines: (N, 1)
        1 where the lamp shines, 0 where not.
    lamp: (3,) metres
    reach: (M,)
        How far q is from p, in distances from p to r; 1 by default.
    """
    reach = np.ones(len(pairs.p)) if reach is None else reach
    sign = np.zeros(len(pairs.p), dtype=np.int8)
    points, radius = in_units(geometry, lines.points, lines.radius)
    place = lamp / geometry.scale
    _classify(
        points, radius, geometry.topology, geometry.size, geometry.start, geometry.direction,
        np.ascontiguousarray(as_numpy(distance)), seen.segment, seen.copy, shadow.segment, shadow.copy, place,
        pairs.p, pairs.q, pairs.r, reach, along_row, sign,
    )  # fmt: skip
    chosen = np.flatnonzero(sign)
    if not len(chosen):
        return []
    pairs, sign = pairs[chosen], sign[chosen]
    t: Tensor = _Crossing.apply(lines.points, lines.radius, distance, geometry, shadow, place, pairs, sign)
    # Light and shadow are the same everywhere on their sides of the rim.
    step = shines[torch.from_numpy(outside(pairs, t))] - shines[torch.from_numpy(inside(pairs, t))]
    return [Jumps(pairs, t, step)]


class _Crossing(torch.autograd.Function):
    """t (M,) of the rims between pairs of pixels."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, radius: Tensor, distance: Tensor, geometry: Geometry, shadow: Seen, lamp: Floats,
        pairs: Pairs, sign: NDArray,
    ) -> Tensor:  # fmt: skip
        ctx.save_for_backward(points, radius, distance)
        t = np.empty(len(sign))
        # The segments that cast the shadow beside the rays of p and q, and their copies.
        beside, copies = np.empty((2, len(sign)), dtype=np.int64), np.empty((2, len(sign), 2), dtype=np.int64)
        _cross(
            *in_units(geometry, points, radius), geometry.topology, geometry.size, geometry.start, geometry.direction,
            np.ascontiguousarray(as_numpy(distance)), shadow.segment, shadow.copy, lamp, pairs.p, pairs.q, sign,
            beside, copies, t,
        )  # fmt: skip
        ctx.geometry, ctx.lamp, ctx.pairs, ctx.sign, ctx.beside, ctx.copies = (
            geometry, lamp, pairs, sign, beside, copies
        )  # fmt: skip
        return torch.from_numpy(t)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_t: Tensor) -> tuple[Tensor | None, ...]:
        points, radius, distance = ctx.saved_tensors
        geometry: Geometry = ctx.geometry
        by_points, by_radius, by_distance = np.zeros(tuple(points.shape)), np.zeros(2), np.zeros(len(distance))
        _cross_slopes(
            *in_units(geometry, points, radius), geometry.topology, geometry.size, geometry.start, geometry.direction,
            np.ascontiguousarray(as_numpy(distance)), ctx.lamp, ctx.pairs.p, ctx.pairs.q, ctx.sign, ctx.beside,
            ctx.copies, np.ascontiguousarray(as_numpy(by_t)), by_points, by_radius, by_distance,
        )  # fmt: skip
        return (
            torch.from_numpy(by_points / geometry.scale), torch.from_numpy(by_radius / geometry.scale),
            torch.from_numpy(by_distance), None, None, None, None, None,
        )  # fmt: skip


@njit(**INLINE)
def _met(points, radius, topology, size, start, direction, segment, copy, of, at):
    """Distance at which the ray of pixel ``at`` meets, or passes beside, the fiber that pixel ``of`` sees."""
    ox, oy, oz, dx, dy, dz = (
        start[at, 0], start[at, 1], start[at, 2], direction[at, 0], direction[at, 1], direction[at, 2]
    )  # fmt: skip
    s, i, j = np.int64(segment[of]), np.int64(copy[of, 0]), np.int64(copy[of, 1])
    s, i, j = settled(points, radius, topology, size, s, i, j, ox, oy, oz, dx, dy, dz)
    ends = ends_of(points, topology, size, s, i, j, ox, oy, oz)
    h, middle, half = pass_by(ends, radius[topology[s, SYSTEM]], dx, dy, dz)
    return middle - half * math.sqrt(max(1.0 - h * h, 0.0) + EPSILON)


@njit(**INLINE)
def _ray(start, direction, t, lamp, at):
    """From a distance along the ray of pixel ``at`` to the lamp: (place (3), unit vector (3), length)."""
    ox, oy, oz = (
        start[at, 0] + t * direction[at, 0], start[at, 1] + t * direction[at, 1], start[at, 2] + t * direction[at, 2]
    )  # fmt: skip
    x, y, z = lamp[0] - ox, lamp[1] - oy, lamp[2] - oz
    length = math.sqrt(x * x + y * y + z * z)
    return ox, oy, oz, x / length, y / length, z / length, length


@njit(**INLINE)
def _cast(points, radius, topology, size, start, direction, distance, lamp, segment, i, j, at):
    """h of the fiber that casts the shadow, along the ray of pixel ``at``; and its segment there."""
    return _cast_at(points, radius, topology, size, start, direction, distance[at], lamp, segment, i, j, at)


@njit(**INLINE)
def _cast_at(points, radius, topology, size, start, direction, t, lamp, segment, i, j, at):
    """The same for a place at distance t along that ray."""
    ox, oy, oz, x, y, z, _ = _ray(start, direction, t, lamp, at)
    segment, i, j = settled(points, radius, topology, size, segment, i, j, ox, oy, oz, x, y, z)
    ends = ends_of(points, topology, size, segment, i, j, ox, oy, oz)
    return pass_by(ends, radius[topology[segment, SYSTEM]], x, y, z)[0], segment, i, j


@njit(**ENTRY, parallel=True)
def _classify(
    points_, radius_, topology_, size_, start_, direction_, distance_, segment_, copy_, caster, caster_copy, lamp_,
    p, q, r, reach, along_row, sign,
):  # fmt: skip
    count = len(p)
    for block in prange((count + BLOCK - 1) // BLOCK):
        points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
        start, direction, distance, lamp = borrow(start_), borrow(direction_), borrow(distance_), borrow(lamp_)
        segment, copy = borrow(segment_), borrow(copy_)
        for m in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            a, b, c = p[m], q[m], r[m]
            if (caster[a] < 0) == (caster[b] < 0) or segment[a] < 0 or not same_fiber(topology, segment, copy, a, b):
                continue
            owner, lit = (a, b) if caster[a] >= 0 else (b, a)
            s, i, j = np.int64(caster[owner]), np.int64(caster_copy[owner, 0]), np.int64(caster_copy[owner, 1])
            at_p = _cast(points, radius, topology, size, start, direction, distance, lamp, s, i, j, a)[0]
            at_q = _cast(points, radius, topology, size, start, direction, distance, lamp, s, i, j, b)[0]
            # At r another fiber may be seen. How the rim runs is told by the fiber of p there, or what lies beside it.
            far = _met(points, radius, topology, size, start, direction, segment, copy, a, c)
            at_r = _cast_at(points, radius, topology, size, start, direction, far, lamp, s, i, j, c)[0]
            row, column = abs(at_q - at_p) / reach[m], abs(at_r - at_p)
            if row >= column if along_row else row > column:
                beyond = at_p if lit == a else at_q
                sign[m] = 1 if beyond > 0.0 else -1


@njit(**ENTRY, parallel=True)
def _cross(
    points_, radius_, topology_, size_, start_, direction_, distance_, caster, caster_copy, lamp_, p, q, sign, beside,
    copies, t,
):  # fmt: skip
    count = len(p)
    for block in prange((count + BLOCK - 1) // BLOCK):
        points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
        start, direction, distance, lamp = borrow(start_), borrow(direction_), borrow(distance_), borrow(lamp_)
        for m in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            owner = p[m] if caster[p[m]] >= 0 else q[m]
            s, i, j = np.int64(caster[owner]), np.int64(caster_copy[owner, 0]), np.int64(caster_copy[owner, 1])
            at_p, beside[0, m], copies[0, m, 0], copies[0, m, 1] = _cast(
                points, radius, topology, size, start, direction, distance, lamp, s, i, j, p[m]
            )
            at_q, beside[1, m], copies[1, m, 0], copies[1, m, 1] = _cast(
                points, radius, topology, size, start, direction, distance, lamp, s, i, j, q[m]
            )
            t[m] = crossing(sign[m] * at_p - 1.0, sign[m] * at_q - 1.0)


_CHUNK = 32 * BLOCK
"""Pairs whose derivatives are kept before they are added to those by vertices."""


@njit(**ENTRY, parallel=True)
def _cross_slopes(
    points_, radius_, topology_, size_, start_, direction_, distance_, lamp_, p, q, sign, beside, copies, by_t,
    by_points, by_radius, by_distance,
):  # fmt: skip
    count = len(p)
    ends_slopes, radius_slopes, distance_slopes = np.empty((2, _CHUNK, 6)), np.empty((2, _CHUNK)), np.empty((2, _CHUNK))
    for base in range(0, count, _CHUNK):
        rows = min(count - base, _CHUNK)
        for block in prange((rows + BLOCK - 1) // BLOCK):
            points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
            start, direction, distance, lamp = borrow(start_), borrow(direction_), borrow(distance_), borrow(lamp_)
            for row in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
                m = base + row
                first = _offset(
                    points, radius, topology, size, start, direction, distance, lamp, beside, copies, m, 0, p[m]
                )
                second = _offset(
                    points, radius, topology, size, start, direction, distance, lamp, beside, copies, m, 1, q[m]
                )
                by_first, by_second = crossing_slopes(sign[m] * first[0] - 1.0, sign[m] * second[0] - 1.0)
                for side in range(2):
                    found = first if side == 0 else second
                    at = p[m] if side == 0 else q[m]
                    by_h = by_t[m] * sign[m] * (by_first if side == 0 else by_second)
                    _, ends, thick, x, y, z, length = found
                    g = pass_by_slopes(ends, thick, x, y, z, by_h, 0.0, 0.0)
                    for c in range(6):
                        ends_slopes[side, row, c] = g[c]
                    radius_slopes[side, row] = g[6]
                    # The place moves along the camera's ray: segments the other way, and the direction to the lamp.
                    straight = g[7] * x + g[8] * y + g[9] * z
                    distance_slopes[side, row] = -(
                        direction[at, 0] * (g[0] + g[3] + (g[7] - straight * x) / length)
                        + direction[at, 1] * (g[1] + g[4] + (g[8] - straight * y) / length)
                        + direction[at, 2] * (g[2] + g[5] + (g[9] - straight * z) / length)
                    )
        for side in range(2):
            add_to_ends(
                rows, topology_, beside[side, base : base + rows], ends_slopes[side], radius_slopes[side],
                by_points, by_radius,
            )  # fmt: skip
        for row in range(rows):
            by_distance[p[base + row]] += distance_slopes[0, row]
            by_distance[q[base + row]] += distance_slopes[1, row]


@njit(**INLINE)
def _offset(points, radius, topology, size, start, direction, distance, lamp, beside, copies, m, side, at):
    """h of the caster's settled segment, and what it was made of: (h, ends, radius, unit vector (3), length)."""
    ox, oy, oz, x, y, z, length = _ray(start, direction, distance[at], lamp, at)
    s = beside[side, m]
    ends = ends_of(points, topology, size, s, copies[side, m, 0], copies[side, m, 1], ox, oy, oz)
    thick = radius[topology[s, SYSTEM]]
    return pass_by(ends, thick, x, y, z)[0], ends, thick, x, y, z, length
