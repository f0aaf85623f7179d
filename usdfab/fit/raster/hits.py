"""Where camera rays meet fibers, as a differentiable function of the fibers' vertices."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from usdfab.fit.raster.curves import Polylines, as_numpy
from usdfab.fit.raster.segments import (
    BLOCK,
    EPSILON,
    FOLLOWING,
    INLINE,
    SYSTEM,
    Floats,
    Geometry,
    add_to_ends,
    ends_of,
    pass_by,
    pass_by_slopes,
)
from usdfab.fit.raster.visibility import Seen
from usdfab.tracer.intrinsics import ENTRY, KERNEL, borrow


class Meeting(NamedTuple):
    """Where rays enter fibers: distance along the ray in units (N,), unit tangent of the smooth fiber there (N, 3),
    offset h (N,). Zero where a ray meets nothing."""

    distance: Tensor
    tangent: Tensor
    h: Tensor


def meet(geometry: Geometry, lines: Polylines, seen: Seen) -> Meeting:
    """Where all rays of a picture enter the segments that they saw; rays that miss theirs are taken at the side.

    The tangent is blended along the segment, so that it runs on smoothly in the next one, and h belongs to it: with the
    surface's normal projected across the tangent, as the tracer does.
    """
    return Meeting(*_Meet.apply(lines.points, lines.tangents, lines.radius, geometry, seen, 0.0))


SIDE = 0.3
"""Root of 1 - h^2 below which a place is at a fiber's side, for ``sides``."""


def sides(geometry: Geometry, lines: Polylines, seen: Seen) -> Tensor:
    """Distances (N,) as of ``meet``, of rays that go with the fibers' sides.

    Along a ray that stays, the place where it enters a fiber moves the faster, the nearer it is to the fiber's side;
    not so if the ray was aimed there because the fiber ends there.
    """
    distance: Tensor = _Meet.apply(lines.points, lines.tangents, lines.radius, geometry, seen, SIDE)[0]
    return distance


class _Meet(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, tangents: Tensor, radius: Tensor, geometry: Geometry, seen: Seen, side: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.save_for_backward(points, tangents, radius)
        ctx.geometry, ctx.seen, ctx.side = geometry, seen, side
        arguments = _arguments(points, tangents, radius, geometry, seen)
        n = len(geometry.start)
        distance, tangent, h = np.zeros(n), np.zeros((n, 3)), np.zeros(n)
        _meet(*arguments, distance, tangent, h)
        return torch.from_numpy(distance), torch.from_numpy(tangent), torch.from_numpy(h)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_distance: Tensor, by_tangent: Tensor, by_h: Tensor) -> tuple[Tensor | None, ...]:
        points_, tangents_, radius_ = ctx.saved_tensors
        arguments = _arguments(points_, tangents_, radius_, ctx.geometry, ctx.seen)
        points, tangents, radius = (np.zeros(tuple(t.shape)) for t in ctx.saved_tensors)
        given = (np.ascontiguousarray(as_numpy(g)) for g in (by_distance, by_tangent, by_h))
        _meet_slopes(*arguments, ctx.side, *given, points, tangents, radius)
        scale = ctx.geometry.scale
        return (
            torch.from_numpy(points / scale),
            torch.from_numpy(tangents),
            torch.from_numpy(radius / scale),
            None,
            None,
            None,
        )


def _arguments(points: Tensor, tangents: Tensor, radius: Tensor, geometry: Geometry, seen: Seen) -> tuple[Any, ...]:
    return (
        *in_units(geometry, points, radius), np.ascontiguousarray(as_numpy(tangents)),
        geometry.topology, geometry.size, geometry.start, geometry.direction, seen.segment, seen.copy,
    )  # fmt: skip


def in_units(geometry: Geometry, points: Tensor, radius: Tensor) -> tuple[Floats, Floats]:
    """(V, 3) vertices and (2,) radii in the geometry's units."""
    return as_numpy(points) / geometry.scale, as_numpy(radius) / geometry.scale


@njit(**INLINE)
def meeting(ends, tangents, radius, dx, dy, dz):
    """Where a ray from the origin enters a segment: (distance, tangent (3), h).

    Parameters
    ----------
    ends, tangents: tuples of 6
        Of its start and its end.
    """
    h, middle, half = pass_by(ends, radius, dx, dy, dz)
    h = min(max(h, -1.0), 1.0)
    t = middle - half * math.sqrt(max(1.0 - h * h, 0.0) + EPSILON)
    tx, ty, tz, nx, ny, nz, _, _ = _smooth(ends, tangents, t, dx, dy, dz)
    ax, ay, az = dy * tz - dz * ty, dz * tx - dx * tz, dx * ty - dy * tx
    scale = math.sqrt((ax * ax + ay * ay + az * az) * (nx * nx + ny * ny + nz * nz) + EPSILON)
    return t, tx, ty, tz, min(max(-(nx * ax + ny * ay + nz * az) / scale, -1.0), 1.0)


@njit(**INLINE)
def _smooth(ends, tangents, t, dx, dy, dz):
    """At distance t: unit tangent (3), from the axis to there across the tangent (3), place along the segment, and the
    tangent's length before it was made one."""
    sx, sy, sz, ex, ey, ez = ends
    cx, cy, cz = ex - sx, ey - sy, ez - sz
    qx, qy, qz = t * dx - sx, t * dy - sy, t * dz - sz
    u = (qx * cx + qy * cy + qz * cz) / (cx * cx + cy * cy + cz * cz + EPSILON)
    u = min(max(u, 0.0), 1.0)
    tx = (1.0 - u) * tangents[0] + u * tangents[3]
    ty = (1.0 - u) * tangents[1] + u * tangents[4]
    tz = (1.0 - u) * tangents[2] + u * tangents[5]
    norm = math.sqrt(tx * tx + ty * ty + tz * tz + EPSILON)
    tx, ty, tz = tx / norm, ty / norm, tz / norm
    nx, ny, nz = qx - u * cx, qy - u * cy, qz - u * cz
    along = nx * tx + ny * ty + nz * tz
    return tx, ty, tz, nx - along * tx, ny - along * ty, nz - along * tz, u, norm


@njit(**INLINE)
def meeting_slopes(ends, tangents, radius, dx, dy, dz, side, by_t, by_tx, by_ty, by_tz, by_h):
    """Derivatives of a loss by ends (6), tangents (6) and radius, from those by what ``meeting`` returns: 13 floats.

    Where the root of 1 - h^2 is less than ``side``, it has none.
    """
    passing, middle, half = pass_by(ends, radius, dx, dy, dz)
    h = min(max(passing, -1.0), 1.0)
    root = math.sqrt(max(1.0 - h * h, 0.0) + EPSILON)
    t = middle - half * root
    tx, ty, tz, nx, ny, nz, u, norm = _smooth(ends, tangents, t, dx, dy, dz)
    ax, ay, az = dy * tz - dz * ty, dz * tx - dx * tz, dx * ty - dy * tx
    a2, n2 = ax * ax + ay * ay + az * az, nx * nx + ny * ny + nz * nz
    scale = math.sqrt(a2 * n2 + EPSILON)
    offset = -(nx * ax + ny * ay + nz * az) / scale

    # offset = -(n . a) / scale, scale^2 = a^2 n^2 + epsilon; a = d x t
    g = by_h if -1.0 <= offset <= 1.0 else 0.0
    k, w = -g / scale, -g * offset / (scale * scale)
    gx, gy, gz = k * ax + w * a2 * nx, k * ay + w * a2 * ny, k * az + w * a2 * nz
    bx, by, bz = k * nx + w * n2 * ax, k * ny + w * n2 * ay, k * nz + w * n2 * az
    by_tx, by_ty, by_tz = by_tx + by * dz - bz * dy, by_ty + bz * dx - bx * dz, by_tz + bx * dy - by * dx

    # n = m - (m . t) t, m = q - u c
    sx, sy, sz, ex, ey, ez = ends
    cx, cy, cz = ex - sx, ey - sy, ez - sz
    qx, qy, qz = t * dx - sx, t * dy - sy, t * dz - sz
    mx, my, mz = qx - u * cx, qy - u * cy, qz - u * cz
    dot, on = gx * tx + gy * ty + gz * tz, mx * tx + my * ty + mz * tz
    by_tx, by_ty, by_tz = by_tx - dot * mx - on * gx, by_ty - dot * my - on * gy, by_tz - dot * mz - on * gz
    gx, gy, gz = gx - dot * tx, gy - dot * ty, gz - dot * tz

    # t = r / |r|, r = (1 - u) t0 + u t1
    dot = by_tx * tx + by_ty * ty + by_tz * tz
    by_tx, by_ty, by_tz = (by_tx - dot * tx) / norm, (by_ty - dot * ty) / norm, (by_tz - dot * tz) / norm
    by_u = (
        by_tx * (tangents[3] - tangents[0]) + by_ty * (tangents[4] - tangents[1]) + by_tz * (tangents[5] - tangents[2])
    )
    by_u -= gx * cx + gy * cy + gz * cz
    by_cx, by_cy, by_cz = -u * gx, -u * gy, -u * gz

    # u = q . c / c^2, held in [0, 1]
    c2 = cx * cx + cy * cy + cz * cz + EPSILON
    if 0.0 < u < 1.0:
        k = by_u / c2
        gx, gy, gz = gx + k * cx, gy + k * cy, gz + k * cz
        by_cx += k * (qx - 2.0 * u * cx)
        by_cy += k * (qy - 2.0 * u * cy)
        by_cz += k * (qz - 2.0 * u * cz)

    # q = t d - s; t = middle - half root, root^2 = 1 - h^2
    by_t += gx * dx + gy * dy + gz * dz
    by_passing = by_t * half * h / root if -1.0 < passing < 1.0 and root > side else 0.0
    s = pass_by_slopes(ends, radius, dx, dy, dz, by_passing, by_t, -by_t * root)
    return (
        s[0] - gx - by_cx, s[1] - gy - by_cy, s[2] - gz - by_cz, s[3] + by_cx, s[4] + by_cy, s[5] + by_cz,
        (1.0 - u) * by_tx, (1.0 - u) * by_ty, (1.0 - u) * by_tz, u * by_tx, u * by_ty, u * by_tz, s[6],
    )  # fmt: skip


@njit(**INLINE)
def _tangents_of(tangents, topology, segment):
    n = topology[segment, FOLLOWING]
    return (
        tangents[segment, 0], tangents[segment, 1], tangents[segment, 2],
        tangents[n, 0], tangents[n, 1], tangents[n, 2],
    )  # fmt: skip


@njit(**ENTRY, parallel=True)
def _meet(
    points_, radius_, tangents_, topology_, size_, start, direction, segment, copy, distance_, tangent_, h_
):  # fmt: skip
    count = len(start)
    for block in prange((count + BLOCK - 1) // BLOCK):
        points, radius, tangents, topology, size = (
            borrow(points_), borrow(radius_), borrow(tangents_), borrow(topology_), borrow(size_)
        )  # fmt: skip
        for k in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            s = np.int64(segment[k])
            if s < 0:
                continue
            ends = ends_of(
                points, topology, size, s, copy[k, 0], copy[k, 1], start[k, 0], start[k, 1], start[k, 2]
            )  # fmt: skip
            thick = radius[topology[s, SYSTEM]]
            d, x, y, z, h = meeting(
                ends, _tangents_of(tangents, topology, s), thick, direction[k, 0], direction[k, 1], direction[k, 2]
            )  # fmt: skip
            distance_[k], tangent_[k, 0], tangent_[k, 1], tangent_[k, 2], h_[k] = d, x, y, z, h


_CHUNK = 64 * BLOCK
"""Rays whose derivatives are kept before they are added to those by vertices."""


@njit(**ENTRY, parallel=True)
def _meet_slopes(
    points_, radius_, tangents_, topology_, size_, start, direction, segment, copy, side, by_distance, by_tangent, by_h,
    by_points, by_tangents, by_radius,
):  # fmt: skip
    count = len(start)
    ends_slopes, tangent_slopes = np.empty((_CHUNK, 6)), np.empty((_CHUNK, 6))
    radius_slopes = np.empty(_CHUNK)
    for first in range(0, count, _CHUNK):
        rows = min(count - first, _CHUNK)
        for block in prange((rows + BLOCK - 1) // BLOCK):
            points, radius, tangents, topology, size = (
                borrow(points_), borrow(radius_), borrow(tangents_), borrow(topology_), borrow(size_)
            )  # fmt: skip
            for row in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
                k = first + row
                s = np.int64(segment[k])
                if s < 0:
                    continue
                ends = ends_of(
                    points, topology, size, s, copy[k, 0], copy[k, 1], start[k, 0], start[k, 1], start[k, 2]
                )  # fmt: skip
                thick = radius[topology[s, SYSTEM]]
                found = meeting_slopes(
                    ends, _tangents_of(tangents, topology, s), thick, direction[k, 0], direction[k, 1], direction[k, 2],
                    side, by_distance[k], by_tangent[k, 0], by_tangent[k, 1], by_tangent[k, 2], by_h[k],
                )  # fmt: skip
                for c in range(6):
                    ends_slopes[row, c], tangent_slopes[row, c] = found[c], found[6 + c]
                radius_slopes[row] = found[12]
        chosen = segment[first : first + rows]
        add_to_ends(rows, topology_, chosen, ends_slopes, radius_slopes, by_points, by_radius)
        _add_tangents(rows, topology_, chosen, tangent_slopes, by_tangents)


@njit(**KERNEL)
def _add_tangents(rows, topology, segment, slopes, tangents):
    for k in range(rows):
        s = segment[k]
        if s < 0:
            continue
        n = topology[s, FOLLOWING]
        for c in range(3):
            tangents[s, c] += slopes[k, c]
            tangents[n, c] += slopes[k, 3 + c]
