"""Fibers bent onto a surface: every control point at its own place, curves cut exactly where the cloth ends.

A control point at (x, y, z) of the cloth goes to the surface at (x, y), and from there z times the surface's own scale
along its interpolated normal. Fibers of neighbouring tiles share their control points there, so they meet exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from usdfab.fibers.tiles import tile_variants
from usdfab.usd.expand.curves import FiberCurves
from usdfab.usd.expand.divide import Tiling
from usdfab.usd.expand.place import Box, Tint, border_cells, candidates
from usdfab.usd.expand.surface import ClothSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BISECTIONS = 14
_POINTS_AT_ONCE = 2_000_000


def bake_curves(
    surface: ClothSurface,
    tiling: Tiling,
    variants: Sequence[Sequence[FiberCurves]],
    tint: Tint,
    region: Box | None = None,
    limit: Callable[[int], None] = lambda count: None,
) -> list[FiberCurves]:
    """The fibers of a surface, or of its ``region`` (x0, y0, x1, y1 metres of cloth), in world space.

    Parameters
    ----------
    variants:
        Curves of each variant's tile, without overlap.
    limit:
        Called with the number of control points needed before any is made; raises where they are too many.

    Returns
    -------
    One ``FiberCurves`` for each of a tile's, without those of which nothing is left. Yarns are those of the tile.
    Colours vary along the curves where ``tint`` does.
    """
    tiles = candidates(surface, tiling, border_cells(surface, tiling), region)
    which = tile_variants(tiles[:, 1], tiles[:, 2], len(variants))
    per_tile = sum(len(c.points) for c in variants[0])
    limit(per_tile * len(tiles))
    parts: dict[str, list[FiberCurves]] = {}
    step = max(1, _POINTS_AT_ONCE // max(per_tile, 1))
    size = np.asarray(tiling.size)
    for start in range(0, len(tiles), step):
        for variant, curves in enumerate(variants):
            mine = tiles[start : start + step][which[start : start + step] == variant]
            for kind in curves if len(mine) else ():
                found = _bent(surface, kind, mine[:, 0], mine[:, 1:] * size, tint, region)
                if found is not None:
                    parts.setdefault(kind.name, []).append(found)
    return [_joined(found) for found in parts.values()]


def _bent(
    surface: ClothSurface, curves: FiberCurves, chart: Ints, shifts: Floats, tint: Tint, region: Box | None
) -> FiberCurves | None:
    """A tile's curves, once for each of ``shifts`` (K, 2) on the charts (K,); None where nothing is left."""
    copies, count = len(shifts), len(curves.counts)
    local = np.tile(curves.points, (copies, 1))
    local[:, :2] += np.repeat(shifts, len(curves.points), axis=0)
    counts = np.tile(curves.counts, copies)
    owner = np.repeat(np.arange(copies * count), counts)
    of_chart = np.repeat(chart, len(curves.points))
    triangle, _ = _locate(surface, of_chart, local, region)
    local, owner, source = _clipped(surface, chart, count, local, owner, triangle >= 0, region)
    if len(local) == 0:
        return None
    # One curve may have come apart into several.
    starts = np.r_[0, np.flatnonzero(np.diff(owner)) + 1]
    of_curve = source[starts]
    of_chart = np.repeat(chart[of_curve // count], np.diff(np.r_[starts, len(local)]))
    triangle, weights = surface.locate(of_chart, local[:, :2])
    triangle, weights = _carried(surface, owner, local, triangle, weights)
    places = surface.at(triangle, weights)
    points = places.points + (local[:, 2] * places.rise)[:, None] * places.normals
    base = curves.color[of_curve % count]
    colors, factor = base, tint(places.uv, places.tint)
    if np.abs(factor - 1.0).max(initial=0.0) > 1e-4:
        colors = np.minimum(factor * np.repeat(base, np.diff(np.r_[starts, len(local)]), axis=0), 1.0)
    return FiberCurves(
        curves.name, curves.system, points, np.diff(np.r_[starts, len(local)]), curves.yarn[of_curve % count],
        curves.fiber[of_curve % count], colors, curves.radius,
    )  # fmt: skip


def _locate(surface: ClothSurface, chart: Ints, local: Floats, region: Box | None) -> tuple[Ints, Floats]:
    """As ``surface.locate``; -1 also outside the region."""
    triangle, weights = surface.locate(chart, local[:, :2])
    if region is not None:
        inside = ((local[:, :2] >= region[:2]) & (local[:, :2] <= region[2:])).all(axis=1)
        triangle = np.where(inside, triangle, -1)
    return triangle, weights


def _clipped(
    surface: ClothSurface,
    chart: Ints,
    count: int,
    local: Floats,
    owner: Ints,
    inside: NDArray[np.bool_],
    region: Box | None,
) -> tuple[Floats, Ints, Ints]:
    """Control points of what is inside.

    A run of control points inside that ends at the border gets two more at that end: the place on the border, and one
    beyond it with which the spline ends there.

    Returns
    -------
    points (M, 3), number of the run (M,), curve of which it is a part (M,).
    """
    number = len(local)
    same_before, same_after = np.zeros(number, dtype=bool), np.zeros(number, dtype=bool)
    same_before[1:] = owner[1:] == owner[:-1]
    same_after[:-1] = same_before[1:]
    before, after = np.r_[False, inside[:-1]] & same_before, np.r_[inside[1:], False] & same_after
    first, last = np.flatnonzero(inside & ~before), np.flatnonzero(inside & ~after)
    # Whether the run is cut there, or the curve has its own end there.
    cut_first, cut_last = same_before[first], same_after[last]
    # A lone point at a cut is no curve.
    long = (last - first + 1) + cut_first + cut_last >= 3
    first, last, cut_first, cut_last = first[long], last[long], cut_first[long], cut_last[long]
    of_chart = chart[owner // count]
    start = _crossing(surface, of_chart[first], local[first], local[np.maximum(first - 1, 0)], cut_first, region)
    stop = _crossing(surface, of_chart[last], local[last], local[np.minimum(last + 1, number - 1)], cut_last, region)
    lengths = (last - first + 1) + 2 * cut_first + 2 * cut_last
    run = np.repeat(np.arange(len(first)), lengths)
    within = np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    place = within - 2 * cut_first[run]
    inner = (place >= 0) & (place <= (last - first)[run])
    out = np.empty((len(run), 3))
    out[inner] = local[first[run[inner]] + place[inner]]
    ends = np.cumsum(lengths)
    for cut, points, end, phantom, neighbor in (
        (cut_first, start, ends - lengths + 1, ends - lengths, ends - lengths + 2),
        (cut_last, stop, ends - 2, ends - 1, ends - 3),
    ):
        out[end[cut]] = points[cut]
        out[phantom[cut]] = 2.0 * points[cut] - out[neighbor[cut]]
    return out, run, owner[first[run]]


def _crossing(
    surface: ClothSurface, chart: Ints, inside: Floats, outside: Floats, cut: NDArray, region: Box | None
) -> Floats:
    """(N, 3) the last place inside on the line from ``inside`` to ``outside``, by bisection; only where ``cut``."""
    low, high = np.zeros(len(inside)), np.ones(len(inside))
    rows = np.flatnonzero(cut)
    for _ in range(_BISECTIONS if len(rows) else 0):
        middle = 0.5 * (low[rows] + high[rows])
        point = inside[rows] + middle[:, None] * (outside - inside)[rows]
        on = _locate(surface, chart[rows], point, region)[0] >= 0
        low[rows], high[rows] = np.where(on, middle, low[rows]), np.where(on, high[rows], middle)
    return inside + low[:, None] * (outside - inside)


def _carried(surface: ClothSurface, run: Ints, local: Floats, triangle: Ints, weights: Floats) -> tuple[Ints, Floats]:
    """Places beyond the border (the last control points of clipped curves) go on in their neighbour's triangle."""
    for shift in (1, -1, 2, -2):
        lost = np.flatnonzero(triangle < 0)
        if len(lost) == 0:
            break
        neighbor = np.clip(lost + shift, 0, len(local) - 1)
        usable = (run[neighbor] == run[lost]) & (triangle[neighbor] >= 0)
        lost, neighbor = lost[usable], neighbor[usable]
        triangle[lost] = triangle[neighbor]
        weights[lost] = surface.weights(triangle[lost], local[lost, :2])
    assert (triangle >= 0).all(), "every run has points inside"
    return triangle, weights


def _joined(parts: list[FiberCurves]) -> FiberCurves:
    first = parts[0]
    colors = [p.color for p in parts]
    if any(len(p.color) == len(p.points) for p in parts):
        colors = [p.color if len(p.color) == len(p.points) else np.repeat(p.color, p.counts, axis=0) for p in parts]
    points, counts, yarn, fiber = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("points", "counts", "yarn", "fiber")
    )
    return FiberCurves(first.name, first.system, points, counts, yarn, fiber, np.concatenate(colors), first.radius)
