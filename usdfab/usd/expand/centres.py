"""Which cells of a grid over the cloth's plane have their centre in which triangle. NumPy only.

A cell (i, j) covers from (i, j) to (i + 1, j + 1) times its size.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_CHUNK = 4_000_000


def estimate(xy: Floats, cell: tuple[float, float]) -> float:
    """About how many cells lie on triangles (T, 3, 2): their area over the cell's."""
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / (cell[0] * cell[1]))


def centres_inside(xy: Floats, cell: Floats) -> tuple[Ints, Ints]:
    """(N,) triangle and (N, 2) column and row of each cell whose centre lies in a triangle.

    Parameters
    ----------
    xy: (T, 3, 2), cell: (2,)

    A centre on an edge that two triangles share belongs to exactly one of them.
    """
    parts = list(_centres_inside(xy, np.asarray(cell)))
    triangle = np.concatenate([t for t, _ in parts]) if parts else np.zeros(0, dtype=np.int64)
    index = np.concatenate([c for _, c in parts]) if parts else np.zeros((0, 2), dtype=np.int64)
    order = np.lexsort((triangle, index[:, 0], index[:, 1]))
    return triangle[order], index[order]


def _centres_inside(uv: Floats, cell: Floats) -> Iterator[tuple[Ints, Ints]]:
    """(triangle, (column, row)) of the centres inside, some triangles at a time."""
    low, high = uv.min(axis=1), uv.max(axis=1)
    # A little slack: whether a centre lies inside is decided below, without rounding differences between triangles.
    first = np.ceil(low / cell - 0.5 - 1e-9).astype(np.int64)
    counts = np.maximum(np.floor(high / cell - 0.5 + 1e-9).astype(np.int64) - first + 1, 0)
    number = counts.prod(axis=1)
    used = np.flatnonzero(number)
    if len(used) == 0:
        return
    chunk = np.cumsum(number[used]) // _CHUNK
    for part in np.split(used, np.flatnonzero(np.diff(chunk)) + 1):
        triangle = np.repeat(part, number[part])
        start = np.concatenate([[0], np.cumsum(number[part])[:-1]]).astype(np.int64)
        within = np.arange(len(triangle)) - np.repeat(start, number[part])
        columns = counts[triangle, 0]
        index = first[triangle] + np.stack([within % columns, within // columns], axis=1)
        centre = (index + 0.5) * cell
        inside = _inside(uv[triangle], centre)
        yield triangle[inside], index[inside]


def _inside(uv: Floats, p: Floats) -> NDArray[np.bool_]:
    """Whether each point is in its triangle; a point on an edge counts for the triangle on one fixed side of the edge.

    Each edge is evaluated from its lexicographically smaller end, so that both triangles get the same number. A point
    on an edge is taken to lie to its left: as if it were moved by (-d^2, d), the same for all edges.
    """
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    winding = np.sign(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    inside = winding != 0
    for k in range(3):
        start, end = uv[:, k], uv[:, (k + 1) % 3]
        forward = (start[:, 0] < end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] < end[:, 1]))
        small, large = np.where(forward[:, None], start, end), np.where(forward[:, None], end, start)
        d, q = large - small, p - small
        left = d[:, 0] * q[:, 1] - d[:, 1] * q[:, 0] >= 0
        inside &= left == ((winding > 0) == forward)
    return inside
