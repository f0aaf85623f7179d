"""What each pixel sees and what shadows it: Embree on the patch, which repeats for ever, in one Numba kernel.

Fibers are round segments: from the camera a round segment looks exactly like a ribbon that faces it, and unlike a
ribbon it has the right surface for shadow rays. Nothing here has gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from usdfab.fit.raster.curves import CurveModel
from usdfab.tracer import embree
from usdfab.tracer.embree import EmbreeScene, curve_scene
from usdfab.tracer.intrinsics import ENTRY, KERNEL, PRIM, filter_address, new_ray_buffer
from usdfab.tracer.patch_scene import FIBER_RADIUS_UNITS
from usdfab.tracer.slab import HIT, trace_slab
from usdfab.tracer.world import EPSILON, HEIGHT, HIGH, LOW, PATCH_COLUMNS, UNITS, WIDTH

NOTHING = -1


@dataclass(frozen=True)
class Seen:
    """What rays met, (N,) each: the segment (the number of its first vertex) or ``NOTHING``, and its copy (N, 2).

    A copy (i, j) is shifted by i and j times the patch's size.
    """

    segment: NDArray[np.int32]
    copy: NDArray[np.int32]


def taken(seen: Seen, rows: NDArray) -> Seen:
    """What some of the rays met."""
    return Seen(seen.segment[rows], seen.copy[rows])


@dataclass(frozen=True)
class PatchIndex:
    """A patch ready for rays. ``table`` (1, PATCH_COLUMNS) as of the tracer; lengths in its units.

    ``segment`` and ``copy`` tell which segment, shifted by how many patches, an Embree primitive is; ``curve`` (V,)
    which fiber a segment belongs to, ``ends`` (V, 7) are the places of its two ends and its radius.
    """

    scene: EmbreeScene
    table: NDArray[np.float64]
    segment: NDArray[np.int32]
    copy: NDArray[np.int32]
    curve: NDArray[np.int32]
    ends: NDArray[np.float64]

    @property
    def units(self) -> float:
        """Units per metre."""
        return float(self.table[0, UNITS])


def index_patch(model: CurveModel, points: NDArray[np.float64], radius: NDArray[np.float64]) -> PatchIndex:
    """All segments that overlap the patch, copies from its neighbours included, as an Embree scene.

    Parameters
    ----------
    points: (V, 3), radius: (2,)
        Values of ``Polylines``, metres.
    """
    units = FIBER_RADIUS_UNITS / float(radius.min())
    points = units * points
    period = units * np.array(model.size)
    thick = units * radius[model.system]
    pad = np.zeros((len(points), 1))
    ends = points[model.following] + np.c_[model.following_shift * period, pad]
    reach = thick[:, None]
    low = np.minimum(points, ends)[:, :2] - reach
    high = np.maximum(points, ends)[:, :2] + reach
    # Copy k shows x + k * period: it overlaps [0, period) where -high < k * period < period - low.
    first = np.floor(-high / period).astype(np.int64) + 1
    last = np.ceil(1.0 - low / period).astype(np.int64) - 1
    count = np.prod(np.maximum(last - first + 1, 0), axis=1)
    segment = np.repeat(np.arange(len(points)), count)
    place = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    wide = (last - first + 1)[segment, 0]
    copy = first[segment] + np.c_[place % wide, place // wide]

    # Each segment brings its own two vertices and ends in two spheres. Embree can leave those out where segments join,
    # but then loses rays at the joints of such coarse curves.
    shift = np.c_[copy * period, np.zeros(len(copy))][:, None, :]
    vertices = np.stack([points[segment], ends[segment]], axis=1) + shift
    thickness = np.broadcast_to(thick[segment][:, None, None], (len(segment), 2, 1))
    scene = curve_scene(
        np.concatenate([vertices, thickness], axis=2).reshape(-1, 4),
        2 * np.arange(len(segment)),
        np.zeros(len(segment), dtype=np.uint8),
    )
    bottom = float((np.minimum(points[:, 2], ends[:, 2]) - thick).min())
    top = float((np.maximum(points[:, 2], ends[:, 2]) + thick).max())
    table = np.zeros((1, PATCH_COLUMNS))
    table[0, [WIDTH, HEIGHT]] = period
    table[0, [LOW, HIGH]] = bottom - 1e-3 * FIBER_RADIUS_UNITS, top + 1e-3 * FIBER_RADIUS_UNITS
    table[0, EPSILON], table[0, UNITS] = 5e-3 * FIBER_RADIUS_UNITS, units
    return PatchIndex(
        scene, table, segment.astype(np.int32), copy.astype(np.int32), model.curve.astype(np.int32),
        np.c_[points, ends, thick],
    )  # fmt: skip


def look(
    index: PatchIndex, eye: NDArray[np.float64], directions: NDArray[np.float64], lamps: NDArray[np.float64]
) -> tuple[Seen, list[Seen]]:
    """What camera rays meet, and what stands between that and each lamp.

    Parameters
    ----------
    eye: (3,), directions: (N, 3) unit vectors, lamps: (K, 3)
        Camera, rays that go down, and point lights above the fibers; patch frame, metres.

    Returns
    -------
    seen, shadows:
        ``shadows[k].segment`` is ``NOTHING`` where lamp k shines.
    """
    n, k = len(directions), len(lamps)
    segment, copy = np.full((1 + k, n), NOTHING, dtype=np.int32), np.zeros((1 + k, n, 2), dtype=np.int32)
    _look(
        np.uint64(embree.function_addresses()[0]), np.uint64(filter_address()),
        np.array([index.scene.handle], dtype=np.uint64), index.table, index.segment, index.copy, index.curve,
        index.units * np.asarray(eye, dtype=np.float64), np.ascontiguousarray(directions, dtype=np.float64),
        index.units * np.asarray(lamps, dtype=np.float64).reshape(-1, 3), segment, copy,
    )  # fmt: skip
    found = [Seen(s, c) for s, c in zip(segment, copy, strict=True)]
    return found[0], found[1:]


def shadows_at(
    index: PatchIndex, places: NDArray[np.float64], seen: Seen, cover: Seen, lamps: NDArray[np.float64]
) -> list[Seen]:
    """What stands between places (N, 3) on the fibers ``seen`` and each lamp, as of ``look``; patch frame, metres.

    A place may lie within the fiber ``cover`` that runs into its own, not deep under its surface. Then it is lit as the
    nearest place at its surface.
    """
    n, k = len(places), len(lamps)
    segment, copy = np.full((k, n), NOTHING, dtype=np.int32), np.zeros((k, n, 2), dtype=np.int32)
    _shadows(
        np.uint64(embree.function_addresses()[0]), np.uint64(filter_address()),
        np.array([index.scene.handle], dtype=np.uint64), index.table, index.segment, index.copy, index.curve,
        index.ends, index.units * places, seen.segment, seen.copy, cover.segment, cover.copy,
        index.units * np.asarray(lamps, dtype=np.float64).reshape(-1, 3), segment, copy,
    )  # fmt: skip
    return [Seen(s, c) for s, c in zip(segment, copy, strict=True)]


def look_past(index: PatchIndex, eye: NDArray[np.float64], directions: NDArray[np.float64], fibers: list[Seen]) -> Seen:
    """What camera rays (N, 3) meet where the fibers of some segments, (N,) each, are not there."""
    n = len(directions)
    segment, copy = np.full(n, NOTHING, dtype=np.int32), np.zeros((n, 2), dtype=np.int32)
    without = np.stack([np.c_[f.segment, f.copy] for f in fibers], axis=1).astype(np.int32)
    _look_past(
        np.uint64(embree.function_addresses()[0]), np.uint64(filter_address()),
        np.array([index.scene.handle], dtype=np.uint64), index.table, index.segment, index.copy, index.curve,
        index.units * np.asarray(eye, dtype=np.float64), np.ascontiguousarray(directions), without, segment, copy,
    )  # fmt: skip
    return Seen(segment, copy)


_ROW = 1024
"""Rays that a thread takes at a time."""

_SELF_HITS = 8
"""Segments of its own fiber that a shadow ray may pass."""


@njit(**ENTRY, parallel=True)
def _look(trace, filter_function, handles, table, segments, copies, curves, eye, directions, lamps, segment, copy):
    count = len(directions)
    for block in prange((count + _ROW - 1) // _ROW):
        memory = new_ray_buffer(filter_function)
        for ray in range(block * _ROW, min(count, (block + 1) * _ROW)):
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            if dz >= 0.0:
                continue
            lx, ly, lz, ix, iy = _entered(table, eye, dx, dy, dz)
            outcome, _, lx, ly, lz, ix, iy, _ = trace_slab(
                trace, table, handles, memory, 0, 1, lx, ly, lz, ix, iy, dx, dy, dz
            )
            if outcome != HIT:
                continue
            hit = np.int64(memory[1][PRIM])
            segment[0, ray] = segments[hit]
            copy[0, ray, 0], copy[0, ray, 1] = ix + copies[hit, 0], iy + copies[hit, 1]
            for lamp in range(len(lamps)):
                found = _caster(
                    trace, table, handles, memory, segments, copies, curves, lx, ly, lz, ix, iy, segment[0, ray],
                    copy[0, ray, 0], copy[0, ray, 1], NOTHING, 0, 0, lamps[lamp, 0], lamps[lamp, 1], lamps[lamp, 2],
                )  # fmt: skip
                segment[1 + lamp, ray], copy[1 + lamp, ray, 0], copy[1 + lamp, ray, 1] = found
        memory[1][0] = np.uint32(0)  # Numba frees an array after its last use: this is after the last ray


@njit(**KERNEL)
def _entered(table, eye, dx, dy, dz):
    """Where a ray that goes down comes to the cloth: place in a tile (3), tile (2)."""
    width, height, top = table[0, WIDTH], table[0, HEIGHT], table[0, HIGH]
    t = (top - eye[2]) / dz
    x, y = eye[0] + t * dx, eye[1] + t * dy
    ix, iy = np.int64(np.floor(x / width)), np.int64(np.floor(y / height))
    return x - ix * width, y - iy * height, top, ix, iy


@njit(**KERNEL)
def _caster(
    trace, table, handles, memory, segments, copies, curves, px, py, pz, jx, jy, own, own_x, own_y, out, out_x, out_y,
    lamp_x, lamp_y, lamp_z,
):  # fmt: skip
    """What stands between a place on fiber ``own``, in tile (jx, jy), and a lamp: (segment or NOTHING, its copy).

    The fiber ``out`` does not count, if it is not NOTHING.
    """
    sx, sy = lamp_x - (px + jx * table[0, WIDTH]), lamp_y - (py + jy * table[0, HEIGHT])
    sz = lamp_z - pz
    norm = 1.0 / np.sqrt(sx * sx + sy * sy + sz * sz)
    for _ in range(_SELF_HITS):
        outcome, _, px, py, pz, jx, jy, _ = trace_slab(
            trace, table, handles, memory, 0, 1, px, py, pz, jx, jy, sx * norm, sy * norm, sz * norm
        )
        if outcome != HIT:
            break
        hit = np.int64(memory[1][PRIM])
        found, cx, cy = segments[hit], jx + copies[hit, 0], jy + copies[hit, 1]
        # Light goes through the fiber that it falls on: that is in its BSDF. On the way it passes the ends of the next
        # segments.
        mine = cx == own_x and cy == own_y and curves[found] == curves[own]
        if not (mine or (out >= 0 and cx == out_x and cy == out_y and curves[found] == curves[out])):
            return found, cx, cy
    return NOTHING, 0, 0


_NEAR = 1.01
"""Radii from a segment's axis within which a place counts as within it."""


@njit(**KERNEL)
def _leaves(ends, x, y, z, dx, dy, dz):
    """Whether a place lies in a segment, and a ray from there leads away from its axis."""
    ax, ay, az = ends[3] - ends[0], ends[4] - ends[1], ends[5] - ends[2]
    x, y, z = x - ends[0], y - ends[1], z - ends[2]
    along = min(max((x * ax + y * ay + z * az) / (ax * ax + ay * ay + az * az), 0.0), 1.0)
    x, y, z = x - along * ax, y - along * ay, z - along * az
    return x * x + y * y + z * z < (_NEAR * ends[6]) ** 2 and x * dx + y * dy + z * dz > 0.0


@njit(**ENTRY, parallel=True)
def _shadows(
    trace, filter_function, handles, table, segments, copies, curves, ends, places, seen, seen_copy, cover, cover_copy,
    lamps, segment, copy,
):  # fmt: skip
    count = len(places)
    for block in prange((count + _ROW - 1) // _ROW):
        memory = new_ray_buffer(filter_function)
        width, height = table[0, WIDTH], table[0, HEIGHT]
        for k in range(block * _ROW, min(count, (block + 1) * _ROW)):
            if seen[k] < 0:
                continue
            x, y, z = places[k, 0], places[k, 1], places[k, 2]
            ix, iy = np.int64(np.floor(x / width)), np.int64(np.floor(y / height))
            for lamp in range(len(lamps)):
                out = cover[k]
                if out >= 0 and not _leaves(
                    ends[out], x - cover_copy[k, 0] * width, y - cover_copy[k, 1] * height, z,
                    lamps[lamp, 0] - x, lamps[lamp, 1] - y, lamps[lamp, 2] - z,
                ):  # fmt: skip
                    out = NOTHING
                found = _caster(
                    trace, table, handles, memory, segments, copies, curves, x - ix * width, y - iy * height, z, ix, iy,
                    seen[k], seen_copy[k, 0], seen_copy[k, 1], out, cover_copy[k, 0], cover_copy[k, 1],
                    lamps[lamp, 0], lamps[lamp, 1], lamps[lamp, 2],
                )  # fmt: skip
                segment[lamp, k], copy[lamp, k, 0], copy[lamp, k, 1] = found
        memory[1][0] = np.uint32(0)  # as above


_PASSED = 4 * _SELF_HITS
"""Segments that a ray may pass on its way past fibers."""


@njit(**ENTRY, parallel=True)
def _look_past(
    trace, filter_function, handles, table, segments, copies, curves, eye, directions, without, segment, copy
):  # fmt: skip
    count = len(directions)
    for block in prange((count + _ROW - 1) // _ROW):
        memory = new_ray_buffer(filter_function)
        for ray in range(block * _ROW, min(count, (block + 1) * _ROW)):
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            if dz >= 0.0:
                continue
            x, y, z, ix, iy = _entered(table, eye, dx, dy, dz)
            for _ in range(_PASSED):
                outcome, _, x, y, z, ix, iy, _ = trace_slab(
                    trace, table, handles, memory, 0, 1, x, y, z, ix, iy, dx, dy, dz
                )
                if outcome != HIT:
                    break
                hit = np.int64(memory[1][PRIM])
                found, cx, cy = segments[hit], ix + copies[hit, 0], iy + copies[hit, 1]
                past = False
                for k in range(without.shape[1]):
                    out = without[ray, k, 0]
                    past |= out >= 0 and cx == without[ray, k, 1] and cy == without[ray, k, 2] and (
                        curves[found] == curves[out]
                    )  # fmt: skip
                if not past:
                    segment[ray], copy[ray, 0], copy[ray, 1] = found, cx, cy
                    break
        memory[1][0] = np.uint32(0)  # as above
