"""Rays and segments of fibers, as Numba functions of scalars, with derivatives written out by hand.

A segment is a cylinder that ends in spheres. Coordinates are relative to the start of a ray, lengths in fiber radii
(``Geometry.scale`` metres). A segment of the patch is named by its first vertex and by its copy (i, j) of the patch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.fit.raster.curves import CurveModel
from usdfab.tracer.intrinsics import KERNEL

Floats = NDArray[np.float64]

FOLLOWING, PRECEDING, NEXT_X, NEXT_Y, BACK_X, BACK_Y, SYSTEM, CURVE = range(8)
"""Columns of ``Geometry.topology``."""

STEPS = 2
"""Segments along a fiber that are searched for the one beside a ray."""

BLOCK = 1024
"""Rays or pairs of pixels that a thread takes at a time."""

EPSILON = 1e-12
"""Added under roots, which have no slope at 0."""
INLINE: dict[str, Any] = {**KERNEL, "forceinline": True}
"""Options of functions that kernels call for each ray: their tuples stay in registers."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the kernels know of a patch and of a picture's rays; lengths in units of ``scale`` metres.

    Parameters
    ----------
    topology: (V, 8) int64
        Of each segment the following and the preceding one, in which copy of the patch those lie, yarn system, fiber.
    size: (2,)
        Of the patch.
    start, direction: (N, 3)
        The camera's rays: places near the cloth, unit vectors.
    color: (V,) int64
        Row of each segment's colour.
    """

    scale: float
    topology: NDArray[np.int64]
    size: Floats
    start: Floats
    direction: Floats
    color: NDArray[np.int64]


def geometry_of(model: CurveModel, start: Floats, direction: Floats, scale: float) -> Geometry:
    """The geometry of a model, looked at along rays from ``start`` (N, 3) metres."""
    columns = (
        model.following, model.preceding, *model.following_shift.T, *model.preceding_shift.T, model.system, model.curve
    )  # fmt: skip
    return Geometry(
        scale,
        np.ascontiguousarray(np.stack(columns, axis=1)),
        np.array(model.size) / scale,
        np.ascontiguousarray(start / scale),
        np.ascontiguousarray(direction),
        np.ascontiguousarray(model.color),
    )


@njit(**INLINE)
def ends_of(points, topology, size, segment, i, j, ox, oy, oz):
    """Both ends of a segment in copy (i, j) of the patch, relative to a place: 6 floats."""
    n = topology[segment, FOLLOWING]
    x, y = i * size[0] - ox, j * size[1] - oy
    return (
        points[segment, 0] + x, points[segment, 1] + y, points[segment, 2] - oz,
        points[n, 0] + x + topology[segment, NEXT_X] * size[0], points[n, 1] + y + topology[segment, NEXT_Y] * size[1],
        points[n, 2] - oz,
    )  # fmt: skip


@njit(**INLINE)
def cylinder(ends, radius, dx, dy, dz):
    """How a ray from the origin passes the infinite cylinder about a segment.

    Parameters
    ----------
    ends: tuple of 6, radius: float
    dx, dy, dz: float
        Unit vector.

    Returns
    -------
    (h, middle, half, along)
        h, middle and half as of ``pass_by``; where along the segment the ray enters or passes by, in [0, 1].
    """
    sx, sy, sz, ex, ey, ez = ends
    ax, ay, az = ex - sx, ey - sy, ez - sz
    length = math.sqrt(ax * ax + ay * ay + az * az + EPSILON)
    ax, ay, az = ax / length, ay / length, az / length
    b = dx * ax + dy * ay + dz * az
    sin2 = max(1.0 - b * b, 1e-6)
    sin = math.sqrt(sin2)
    along_axis = sx * ax + sy * ay + sz * az
    middle = (sx * dx + sy * dy + sz * dz - b * along_axis) / sin2
    half = radius / sin
    h = (sx * (dy * az - dz * ay) + sy * (dz * ax - dx * az) + sz * (dx * ay - dy * ax)) / (sin * radius)
    entry = middle - half * math.sqrt(max(1.0 - h * h, 0.0) + EPSILON)
    return h, middle, half, (b * entry - along_axis) / length


@njit(**INLINE)
def pass_by(ends, radius, dx, dy, dz):
    """How a ray from the origin passes a segment.

    Returns
    -------
    h:
        Signed distance of the ray from the axis, or where it meets the sphere at an end from its centre, in fiber
        radii: beyond -1 and 1 the ray misses.
    middle, half:
        The surface is at ``middle - half * sqrt(1 - h^2)`` along the ray.
    """
    h, middle, half, along = cylinder(ends, radius, dx, dy, dz)
    if 0.0 <= along <= 1.0:
        return h, middle, half
    # The two segments at a joint share its sphere, so that it does not matter which of them Embree names.
    cx, cy, cz = (ends[3], ends[4], ends[5]) if along > 1.0 else (ends[0], ends[1], ends[2])
    nearest = cx * dx + cy * dy + cz * dz
    x, y, z = cx - nearest * dx, cy - nearest * dy, cz - nearest * dz
    distance = math.sqrt(x * x + y * y + z * z + EPSILON) / radius
    return (-distance if h < 0.0 else distance), nearest, radius


@njit(**INLINE)
def pass_by_slopes(ends, radius, dx, dy, dz, by_h, by_middle, by_half):
    """Derivatives of a loss by the arguments of ``pass_by``, from those by its results.

    Returns
    -------
    (by the ends (6), by the radius, by the direction (3)): 10 floats
    """
    sx, sy, sz, ex, ey, ez = ends
    h, middle, half, along = cylinder(ends, radius, dx, dy, dz)
    if not 0.0 <= along <= 1.0:
        cx, cy, cz = (ex, ey, ez) if along > 1.0 else (sx, sy, sz)
        nearest = cx * dx + cy * dy + cz * dz
        x, y, z = cx - nearest * dx, cy - nearest * dy, cz - nearest * dz
        away = math.sqrt(x * x + y * y + z * z + EPSILON)
        g = (-by_h if h < 0.0 else by_h) / (radius * away)
        x, y, z = g * x, g * y, g * z
        back = x * dx + y * dy + z * dz
        gx, gy, gz = x + (by_middle - back) * dx, y + (by_middle - back) * dy, z + (by_middle - back) * dz
        by_radius = by_half - g * away * away / radius
        k = by_middle - back
        by_d = k * cx - nearest * x, k * cy - nearest * y, k * cz - nearest * z
        if along > 1.0:
            return 0.0, 0.0, 0.0, gx, gy, gz, by_radius, by_d[0], by_d[1], by_d[2]
        return gx, gy, gz, 0.0, 0.0, 0.0, by_radius, by_d[0], by_d[1], by_d[2]
    ax, ay, az = ex - sx, ey - sy, ez - sz
    length = math.sqrt(ax * ax + ay * ay + az * az + EPSILON)
    ax, ay, az = ax / length, ay / length, az / length
    b = dx * ax + dy * ay + dz * az
    sin2 = max(1.0 - b * b, 1e-6)
    sin = math.sqrt(sin2)
    along_axis = sx * ax + sy * ay + sz * az
    # h = n / (sin radius), n = s . (d x a); half = radius / sin; middle = (s . d - b s . a) / sin^2
    by_n = by_h / (sin * radius)
    by_radius = by_half / sin - by_h * h / radius
    by_sin2 = (-(by_h * h + by_half * half) / sin * 0.5) / sin - by_middle * middle / sin2
    by_sd, by_b, by_sa = by_middle / sin2, -by_middle * along_axis / sin2, -by_middle * b / sin2
    if 1.0 - b * b > 1e-6:
        by_b -= 2.0 * b * by_sin2
    # by s: n (d x a) + d + a; by d: n (a x s) + s + a; by a: n (s x d) + s + d
    gx = by_n * (dy * az - dz * ay) + by_sd * dx + by_sa * ax
    gy = by_n * (dz * ax - dx * az) + by_sd * dy + by_sa * ay
    gz = by_n * (dx * ay - dy * ax) + by_sd * dz + by_sa * az
    by_dx = by_n * (ay * sz - az * sy) + by_sd * sx + by_b * ax
    by_dy = by_n * (az * sx - ax * sz) + by_sd * sy + by_b * ay
    by_dz = by_n * (ax * sy - ay * sx) + by_sd * sz + by_b * az
    by_ax = by_n * (sy * dz - sz * dy) + by_sa * sx + by_b * dx
    by_ay = by_n * (sz * dx - sx * dz) + by_sa * sy + by_b * dy
    by_az = by_n * (sx * dy - sy * dx) + by_sa * sz + by_b * dz
    straight = by_ax * ax + by_ay * ay + by_az * az
    cx, cy, cz = (by_ax - straight * ax) / length, (by_ay - straight * ay) / length, (by_az - straight * az) / length
    return gx - cx, gy - cy, gz - cz, cx, cy, cz, by_radius, by_dx, by_dy, by_dz


@njit(**INLINE)
def settled(points, radius, topology, size, segment, i, j, ox, oy, oz, dx, dy, dz):
    """The segment of a fiber that lies nearest to a ray: (segment, i, j).

    From the given segment along the fiber, ``STEPS`` segments at most: where along a fiber one segment gives way to the
    next must not matter.
    """
    thick = radius[topology[segment, SYSTEM]]
    for _ in range(STEPS):
        ends = ends_of(points, topology, size, segment, i, j, ox, oy, oz)
        along = cylinder(ends, thick, dx, dy, dz)[3]
        if along > 1.0:
            i, j = i + topology[segment, NEXT_X], j + topology[segment, NEXT_Y]
            segment = topology[segment, FOLLOWING]
        elif along < 0.0:
            i, j = i + topology[segment, BACK_X], j + topology[segment, BACK_Y]
            segment = topology[segment, PRECEDING]
        else:
            break
    return segment, i, j


@njit(**INLINE)
def same_fiber(topology, segment, copy, p, q):
    """Whether pixels p and q show the same piece of fiber, or two that continue each other; or both nothing."""
    a, b = segment[p], segment[q]
    if a < 0 or b < 0:
        return a == b
    dx, dy = copy[q, 0] - copy[p, 0], copy[q, 1] - copy[p, 1]
    if dx == 0 and dy == 0 and topology[a, CURVE] == topology[b, CURVE]:
        return True
    if topology[a, FOLLOWING] == b and topology[a, NEXT_X] == dx and topology[a, NEXT_Y] == dy:
        return True
    return topology[b, FOLLOWING] == a and topology[b, NEXT_X] == -dx and topology[b, NEXT_Y] == -dy


@njit(**KERNEL)
def add_to_ends(rows, topology, segment, by_ends, by_radius, points, radius):
    """Add derivatives by ``rows`` segments' ends (M, 6) and radii (M,) to those by vertices (V, 3) and systems (2,).

    One after the other: sums in the same order every time, whatever the number of threads.
    """
    for k in range(rows):
        s = segment[k]
        if s < 0:
            continue
        n = topology[s, FOLLOWING]
        for c in range(3):
            points[s, c] += by_ends[k, c]
            points[n, c] += by_ends[k, 3 + c]
        radius[topology[s, SYSTEM]] += by_radius[k]
