"""Which jumps between fibers lie between neighbouring pixels, and where: the geometry behind ``edges``.

Either the nearer fiber ends, at its silhouette |h| = 1, or two fibers run into each other. Both are one: a fiber with
its axis at depth a shows in front of a surface at depth d where its half thickness there, sqrt(1 - h^2) radii, is more
than (a - d) / radius. So the jump function of the fiber is sqrt(h^2 + max(a - d, 0)^2 / radius^2) - 1.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.curves import Polylines, as_numpy
from usdfab.fit.raster.edges import Pairs, crossing, crossing_slopes
from usdfab.fit.raster.hits import in_units
from usdfab.fit.raster.segments import (
    BLOCK,
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
from usdfab.fit.raster.visibility import NOTHING, PatchIndex, Seen, look_past, taken
from usdfab.tracer.intrinsics import ENTRY, KERNEL, borrow

NONE, P_ENDS, Q_ENDS, GAP_P, GAP_Q = 0, 1, 2, 4, 8
"""Between two pixels: no jump along this line of pixels; one where what p sees ends; or what q sees. Or there is a gap
between both, narrower than the pixels' distance: bits that say whether the end of what p sees, and of what q sees,
counts along this line."""

ALONG_ROW, ALONG_COLUMN, ANY = 1, 0, 2
"""Jumps that count: those more nearly normal to rows, to columns; all."""

_TINY = 1e-12
_LEAST_ROOT = 1e-9


class Ends(NamedTuple):
    """Where between pixels one fiber gives way to another, or to what lies behind it.

    Parameters
    ----------
    pairs, t: (M,)
        As of ``edges.Jumps``.
    beyond: (M,)
        What is on the other side of the jump, seen from the middle of the pixel with the jump: segments that lie beside
        its ray.
    here: (M,) or None
        What is on this side; None: what the pixel sees.
    """

    pairs: Pairs
    t: Tensor
    beyond: Seen
    here: Seen | None = None


def visible_edges(
    geometry: Geometry, lines: Polylines, index: PatchIndex, eye: Floats, seen: Seen, pairs: Pairs, along_row: bool
) -> list[Ends]:
    """Where between pixels one fiber gives way to another.

    Parameters
    ----------
    index, eye:
        Of what ``seen`` comes.
    pairs:
        All pairs along the rows or, if not ``along_row``, along the columns.
    """
    points, radius = in_units(geometry, lines.points, lines.radius)
    kinds = classified(geometry, points, radius, seen, pairs, along_row)
    plain = np.flatnonzero((kinds == P_ENDS) | (kinds == Q_ENDS))
    t, beside = _crossings(geometry, lines, seen, pairs[plain], kinds[plain], alone=False)
    in_p = as_numpy(t) < 0.5
    row = np.where((kinds[plain] == Q_ENDS) == in_p, 0, 2) + np.where(in_p, 0, 1)
    found = [Ends(pairs[plain], t, _picked(beside, row))]
    for bit, kind in ((GAP_P, P_ENDS), (GAP_Q, Q_ENDS)):
        chosen = np.flatnonzero(kinds & bit)
        t, beside = _crossings(
            geometry, lines, seen, pairs[chosen], np.full(len(chosen), kind, dtype=np.int8), alone=True
        )  # fmt: skip
        in_p = as_numpy(t) < 0.5
        at = np.where(in_p, pairs.p[chosen], pairs.q[chosen])
        behind = look_past(
            index, eye, geometry.direction[at], [taken(seen, pairs.p[chosen]), taken(seen, pairs.q[chosen])]
        )  # fmt: skip
        # In the pixel that sees the fiber, the gap is beyond; in the other, the fiber is, and the gap is here.
        own = in_p == (kind == P_ENDS)
        fiber = _picked(beside, np.where(in_p, 0, 1))
        for rows, beyond, here in ((own, behind, None), (~own, fiber, behind)):
            found.append(
                Ends(
                    pairs[chosen[rows]], t[torch.from_numpy(rows)], taken(beyond, rows),
                    None if here is None else taken(here, rows),
                )
            )  # fmt: skip
    return [ends for ends in found if len(ends.t)]


def _crossings(
    geometry: Geometry, lines: Polylines, seen: Seen, pairs: Pairs, kinds: NDArray[np.int8], alone: bool
) -> tuple[Tensor, tuple[NDArray, NDArray]]:
    """t (M,), and segments (4, M) with their copies: of what ends and of the other, each settled beside p and q.

    ``alone`` is where the other does not matter.
    """
    beside, copies = np.empty((4, len(kinds)), dtype=np.int64), np.empty((4, len(kinds), 2), dtype=np.int64)
    t: Tensor = _Crossing.apply(lines.points, lines.radius, geometry, seen, pairs, kinds, alone, beside, copies)
    return t, (beside, copies)


def _picked(beside: tuple[NDArray, NDArray], row: NDArray) -> Seen:
    column = np.arange(len(row))
    return Seen(*(each[row, column].astype(np.int32) for each in beside))


def classified(
    geometry: Geometry, points: NDArray, radius: NDArray, seen: Seen, pairs: Pairs, along_row: bool
) -> NDArray[np.int8]:
    """(M,) ``NONE``, ``P_ENDS``, ``Q_ENDS`` or bits of ``GAP_P`` and ``GAP_Q`` for pairs of pixels (M,).

    A jump counts along the axis to which it is more nearly normal. The fiber that ends is the one that is farther out
    at the other's pixel, and if both are beyond their sides there, the nearer; or both do, where the one ends before
    the other begins.
    """
    return _kinds_of(geometry, points, radius, seen, pairs, ALONG_ROW if along_row else ALONG_COLUMN)


def _kinds_of(
    geometry: Geometry, points: NDArray, radius: NDArray, seen: Seen, pairs: Pairs, axis: int
) -> NDArray[np.int8]:
    kinds = np.zeros(len(pairs.p), dtype=np.int8)
    _classify(
        points, radius, geometry.topology, geometry.size, geometry.start, geometry.direction, seen.segment, seen.copy,
        pairs.p, pairs.q, pairs.r, axis, kinds,
    )  # fmt: skip
    return kinds


def ends_between(geometry: Geometry, lines: Polylines, seen: Seen, pairs: Pairs) -> tuple[NDArray, Tensor, Tensor]:
    """Where between pixels what p sees ends and what q sees begins, whichever way the jumps run.

    Returns
    -------
    chosen: (M,)
        Which of the pairs see different things.
    end, begin: (M,)
        In [0, 1] from p to q.
    """
    points, radius = in_units(geometry, lines.points, lines.radius)
    kinds = _kinds_of(geometry, points, radius, seen, pairs, ANY)
    chosen = np.flatnonzero(kinds)
    kinds, pairs = kinds[chosen], pairs[chosen]
    gap = kinds > Q_ENDS
    order = torch.from_numpy(np.argsort(np.r_[np.flatnonzero(~gap), np.flatnonzero(gap)], kind="stable"))
    plain, _ = _crossings(geometry, lines, seen, pairs[~gap], kinds[~gap], alone=False)
    alone = [
        _crossings(geometry, lines, seen, pairs[gap], np.full(int(gap.sum()), kind, dtype=np.int8), alone=True)[0]
        for kind in (P_ENDS, Q_ENDS)
    ]
    end, begin = (torch.cat([plain, t])[order] for t in alone)
    return chosen, end, begin


class _Crossing(torch.autograd.Function):
    """t (M,) of the jumps between pairs of pixels."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, radius: Tensor, geometry: Geometry, seen: Seen, pairs: Pairs, kinds: NDArray,
        alone: bool, beside: NDArray, copies: NDArray,
    ) -> Tensor:  # fmt: skip
        """``beside`` (4, M) and ``copies`` (4, M, 2) are filled."""
        ctx.save_for_backward(points, radius)
        t = np.empty(len(kinds))
        _cross(
            *in_units(geometry, points, radius), geometry.topology, geometry.size, geometry.start, geometry.direction,
            seen.segment, seen.copy, pairs.p, pairs.q, kinds, alone, beside, copies, t,
        )  # fmt: skip
        ctx.geometry, ctx.pairs, ctx.beside, ctx.copies = geometry, pairs, beside, copies
        return torch.from_numpy(t)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_t: Tensor) -> tuple[Tensor | None, ...]:
        points, radius = ctx.saved_tensors
        geometry: Geometry = ctx.geometry
        by_points, by_radius = np.zeros(tuple(points.shape)), np.zeros(2)
        _cross_slopes(
            *in_units(geometry, points, radius), geometry.topology, geometry.size, geometry.start, geometry.direction,
            ctx.pairs.p, ctx.pairs.q, ctx.beside, ctx.copies, np.ascontiguousarray(as_numpy(by_t)),
            by_points, by_radius,
        )  # fmt: skip
        by_points, by_radius = by_points / geometry.scale, by_radius / geometry.scale
        return torch.from_numpy(by_points), torch.from_numpy(by_radius), None, None, None, None, None, None, None


@njit(**INLINE)
def _profile(points, radius, topology, size, start, direction, segment, i, j, at):
    """h of a fiber from the ray of pixel ``at``, the depth of its axis, its radius along the ray; and the segment.

    Depths are below the cloth's plane, which the rays of all pixels have in common.
    """
    ox, oy, oz = start[at, 0], start[at, 1], start[at, 2]
    dx, dy, dz = direction[at, 0], direction[at, 1], direction[at, 2]
    segment, i, j = settled(points, radius, topology, size, segment, i, j, ox, oy, oz, dx, dy, dz)
    ends = ends_of(points, topology, size, segment, i, j, ox, oy, oz)
    h, middle, half = pass_by(ends, radius[topology[segment, SYSTEM]], dx, dy, dz)
    return h, -dz * middle, -dz * half, segment, i, j


@njit(**INLINE)
def _depth(h, axis, unit):
    """Of a fiber's surface; beyond its sides, of the sides."""
    return axis - unit * math.sqrt(max(1.0 - h * h, _LEAST_ROOT))


@njit(**INLINE)
def _showing(h, axis, unit, behind):
    """The jump function of a fiber before a surface at depth ``behind``."""
    sunk = max((axis - behind) / unit, 0.0)
    return math.sqrt(h * h + sunk * sunk + _TINY) - 1.0


@njit(**INLINE)
def _counts(row, column, axis):
    """Whether a jump counts whose function changes so much along the row and along the column."""
    return axis == ANY or (row >= column if axis == ALONG_ROW else row > column)


@njit(**ENTRY, parallel=True)
def _classify(points_, radius_, topology_, size_, start_, direction_, segment_, copy_, p, q, r, axis, kinds):
    count = len(p)
    for block in prange((count + BLOCK - 1) // BLOCK):
        points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
        start, direction, segment, copy = borrow(start_), borrow(direction_), borrow(segment_), borrow(copy_)
        for m in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            at_p, at_q = p[m], q[m]
            if not same_fiber(topology, segment, copy, at_p, at_q):
                kinds[m] = _kind(
                    points, radius, topology, size, start, direction, segment, copy, at_p, at_q, r[m], axis
                )


@njit(**KERNEL)
def _kind(points, radius, topology, size, start, direction, segment, copy, p, q, r, axis):
    a, b = np.int64(segment[p]), np.int64(segment[q])
    if a < 0 or b < 0:
        # One of them sees nothing behind: the other ends.
        of = q if a < 0 else p
        s, i, j = np.int64(segment[of]), np.int64(copy[of, 0]), np.int64(copy[of, 1])
        at_p = _profile(points, radius, topology, size, start, direction, s, i, j, p)
        at_q = _profile(points, radius, topology, size, start, direction, s, i, j, q)
        at_r = _profile(points, radius, topology, size, start, direction, s, i, j, r)
        here, row, column = math.sqrt(at_p[0] ** 2 + _TINY), at_q[0], at_r[0]
        row, column = abs(math.sqrt(row * row + _TINY) - here), abs(math.sqrt(column * column + _TINY) - here)
        keep = _counts(row, column, axis)
        return (Q_ENDS if a < 0 else P_ENDS) if keep else NONE
    i, j = np.int64(copy[p, 0]), np.int64(copy[p, 1])
    a_p = _profile(points, radius, topology, size, start, direction, a, i, j, p)
    a_q = _profile(points, radius, topology, size, start, direction, a, i, j, q)
    a_r = _profile(points, radius, topology, size, start, direction, a, i, j, r)
    i, j = np.int64(copy[q, 0]), np.int64(copy[q, 1])
    b_p = _profile(points, radius, topology, size, start, direction, b, i, j, p)
    b_q = _profile(points, radius, topology, size, start, direction, b, i, j, q)
    b_r = _profile(points, radius, topology, size, start, direction, b, i, j, r)
    out_a, out_b = abs(a_q[0]), abs(b_p[0])
    if out_a > 1.0 and out_b > 1.0:
        end_a, end_b = crossing(abs(a_p[0]) - 1.0, out_a - 1.0), crossing(out_b - 1.0, abs(b_q[0]) - 1.0)
        if end_a < end_b:
            return _gap(a_p[0], a_q[0], a_r[0], b_p[0], b_q[0], b_r[0], axis)
        a_ends = _depth(a_p[0], a_p[1], a_p[2]) <= _depth(b_q[0], b_q[1], b_q[2])
    else:
        a_ends = out_a > out_b
    if not a_ends:
        a_p, a_q, a_r, b_p, b_q, b_r = b_p, b_q, b_r, a_p, a_q, a_r
    here = _showing(a_p[0], a_p[1], a_p[2], _depth(b_p[0], b_p[1], b_p[2]))
    row = abs(_showing(a_q[0], a_q[1], a_q[2], _depth(b_q[0], b_q[1], b_q[2])) - here)
    column = abs(_showing(a_r[0], a_r[1], a_r[2], _depth(b_r[0], b_r[1], b_r[2])) - here)
    keep = _counts(row, column, axis)
    return (P_ENDS if a_ends else Q_ENDS) if keep else NONE


@njit(**INLINE)
def _gap(a_p, a_q, a_r, b_p, b_q, b_r, axis):
    """Which ends of two fibers count along this line of pixels, from their h at p, q and r."""
    kind = NONE
    row, column = abs(abs(a_q) - abs(a_p)), abs(abs(a_r) - abs(a_p))
    if _counts(row, column, axis):
        kind |= GAP_P
    row, column = abs(abs(b_q) - abs(b_p)), abs(abs(b_r) - abs(b_p))
    if _counts(row, column, axis):
        kind |= GAP_Q
    return kind


@njit(**ENTRY, parallel=True)
def _cross(
    points_, radius_, topology_, size_, start_, direction_, segment, copy, p, q, kinds, alone, beside, copies, t
):  # fmt: skip
    count = len(p)
    for block in prange((count + BLOCK - 1) // BLOCK):
        points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
        start, direction = borrow(start_), borrow(direction_)
        for m in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            one, other = (p[m], q[m]) if kinds[m] == P_ENDS else (q[m], p[m])
            a, i, j = np.int64(segment[one]), np.int64(copy[one, 0]), np.int64(copy[one, 1])
            b, k, n = np.int64(segment[other]), np.int64(copy[other, 0]), np.int64(copy[other, 1])
            first = second = 0.0
            for side in range(2):
                at = p[m] if side == 0 else q[m]
                h, axis, unit, s, x, y = _profile(points, radius, topology, size, start, direction, a, i, j, at)
                beside[side, m], copies[side, m, 0], copies[side, m, 1] = s, x, y
                behind = math.inf
                beside[2 + side, m] = NOTHING
                if b >= 0 and not alone:
                    ho, axis_o, unit_o, s, x, y = _profile(
                        points, radius, topology, size, start, direction, b, k, n, at
                    )  # fmt: skip
                    beside[2 + side, m], copies[2 + side, m, 0], copies[2 + side, m, 1] = s, x, y
                    behind = _depth(ho, axis_o, unit_o)
                first, second = second, _showing(h, axis, unit, behind)
            t[m] = crossing(first, second)


_CHUNK = 32 * BLOCK
"""Pairs whose derivatives are kept before they are added to those by vertices."""


@njit(**ENTRY, parallel=True)
def _cross_slopes(
    points_, radius_, topology_, size_, start_, direction_, p, q, beside, copies, by_t, by_points, by_radius
):  # fmt: skip
    count = len(p)
    ends_slopes, radius_slopes = np.empty((4, _CHUNK, 6)), np.empty((4, _CHUNK))
    for base in range(0, count, _CHUNK):
        rows = min(count - base, _CHUNK)
        for block in prange((rows + BLOCK - 1) // BLOCK):
            points, radius, topology, size = borrow(points_), borrow(radius_), borrow(topology_), borrow(size_)
            start, direction = borrow(start_), borrow(direction_)
            for row in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
                m = base + row
                first = _showing_beside(points, radius, topology, size, start, direction, beside, copies, m, 0, p[m])
                second = _showing_beside(points, radius, topology, size, start, direction, beside, copies, m, 1, q[m])
                by_first, by_second = crossing_slopes(first, second)
                for side in range(2):
                    _showing_slopes(
                        points, radius, topology, size, start, direction, beside, copies, m, side,
                        p[m] if side == 0 else q[m], by_t[m] * (by_first if side == 0 else by_second),
                        row, ends_slopes, radius_slopes,
                    )  # fmt: skip
        for which in range(4):
            add_to_ends(
                rows, topology_, beside[which, base : base + rows], ends_slopes[which], radius_slopes[which],
                by_points, by_radius,
            )  # fmt: skip


@njit(**INLINE)
def _settled_profile(points, radius, topology, size, start, direction, beside, copies, m, which, at):
    s = beside[which, m]
    ends = ends_of(
        points, topology, size, s, copies[which, m, 0], copies[which, m, 1], start[at, 0], start[at, 1], start[at, 2]
    )
    thick = radius[topology[s, SYSTEM]]
    h, middle, half = pass_by(ends, thick, direction[at, 0], direction[at, 1], direction[at, 2])
    down = -direction[at, 2]
    return h, down * middle, down * half, ends, thick


@njit(**INLINE)
def _showing_beside(points, radius, topology, size, start, direction, beside, copies, m, side, at):
    """The jump function at pixel ``at``, which is p (side 0) or q (1)."""
    h, axis, unit, _, _ = _settled_profile(
        points, radius, topology, size, start, direction, beside, copies, m, side, at
    )  # fmt: skip
    behind = math.inf
    if beside[2 + side, m] >= 0:
        ho, axis_o, unit_o, _, _ = _settled_profile(
            points, radius, topology, size, start, direction, beside, copies, m, 2 + side, at
        )
        behind = _depth(ho, axis_o, unit_o)
    return _showing(h, axis, unit, behind)


@njit(**KERNEL)
def _showing_slopes(
    points, radius, topology, size, start, direction, beside, copies, m, side, at, by_showing, row, ends_slopes,
    radius_slopes,
):  # fmt: skip
    """Derivatives of a loss by the segments at pixel ``at``, from that by the jump function there."""
    h, axis, unit, ends, thick = _settled_profile(
        points, radius, topology, size, start, direction, beside, copies, m, side, at
    )
    dx, dy, dz = direction[at, 0], direction[at, 1], direction[at, 2]
    by_axis = by_unit = 0.0
    if beside[2 + side, m] >= 0:
        ho, axis_o, unit_o, ends_o, thick_o = _settled_profile(
            points, radius, topology, size, start, direction, beside, copies, m, 2 + side, at
        )
        root = math.sqrt(max(1.0 - ho * ho, _LEAST_ROOT))
        sunk = max((axis - axis_o + unit_o * root) / unit, 0.0)
        norm = math.sqrt(h * h + sunk * sunk + _TINY)
        by_sunk = by_showing * sunk / norm
        by_axis, by_unit = by_sunk / unit, -by_sunk * sunk / unit
        by_ho = -by_axis * unit_o * ho / root if 1.0 - ho * ho > _LEAST_ROOT else 0.0
        found = pass_by_slopes(ends_o, thick_o, dx, dy, dz, by_ho, by_axis * dz, -by_axis * root * dz)
        for c in range(6):
            ends_slopes[2 + side, row, c] = found[c]
        radius_slopes[2 + side, row] = found[6]
    else:
        norm = math.sqrt(h * h + _TINY)
    found = pass_by_slopes(ends, thick, dx, dy, dz, by_showing * h / norm, -by_axis * dz, -by_unit * dz)
    for c in range(6):
        ends_slopes[side, row, c] = found[c]
    radius_slopes[side, row] = found[6]
