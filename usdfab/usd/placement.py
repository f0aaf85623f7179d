"""Where copies of a patch go on a mesh: one for each patch cell of the uv plane whose centre lies on the cloth.

A cell (i, j) covers uv from (i, j) to (i + 1, j + 1) times the patch's size in uv. NumPy only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Region = tuple[float, float, float, float]
_CHUNK = 4_000_000


@dataclass(frozen=True, eq=False)
class Placement:
    """Copies of a patch on a mesh, N of them.

    Parameters
    ----------
    positions: (N, 3) metres
        Where the centres of the cells lie on the mesh.
    rotations: (N, 3, 3)
        Proper rotations; columns are the directions of the weft (dp/du), of the third axis, and of the front normal.
    scales: (N, 3)
        Metres of world per metre of cloth along the patch's x, y and z; y is negative where uv is mirrored.
    cells: (N, 2) int
        Column and row of the cell.
    """

    positions: Floats
    rotations: Floats
    scales: Floats
    cells: Ints


def estimate(uv: Floats, cell: tuple[float, float]) -> float:
    """About how many cells lie on the triangles: area in uv over the cell's area."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / (cell[0] * cell[1]))


def place(
    points: Floats,
    uv: Floats,
    normals: Floats | None,
    cell: tuple[float, float],
    meters_per_uv: float,
    region: Region | None = None,
) -> Placement:
    """Put cells on triangles.

    Parameters
    ----------
    points: (T, 3, 3) metres, uv: (T, 3, 2), normals: (T, 3, 3) unit or None
        At the triangles' corners, counter-clockwise seen from the front.
    cell: (2,)
        Size of the patch in uv.
    region:
        ``(u0, v0, u1, v1)``: only cells whose centre lies there.

    A centre on an edge that two triangles share belongs to exactly one of them. Where a surface stretches its uv, a
    copy is stretched along x and y so that it still meets its neighbours (shear is not followed), and in height by the
    geometric mean of the two.
    """
    triangles, cells = [], []
    for triangle, found in _centres_inside(uv, np.asarray(cell), region):
        triangles.append(triangle)
        cells.append(found)
    triangle = np.concatenate(triangles) if triangles else np.zeros(0, dtype=np.int64)
    index = np.concatenate(cells) if cells else np.zeros((0, 2), dtype=np.int64)
    order = np.lexsort((triangle, index[:, 0], index[:, 1]))
    triangle, index = triangle[order], index[order]
    chosen = None if normals is None else normals[triangle]
    return _frames(points[triangle], uv[triangle], chosen, cell, meters_per_uv, index)


def _centres_inside(uv: Floats, cell: Floats, region: Region | None) -> Iterator[tuple[Ints, Ints]]:
    """(triangle, (column, row)) of the centres inside, some triangles at a time."""
    low, high = uv.min(axis=1), uv.max(axis=1)
    if region is not None:
        low, high = np.maximum(low, region[:2]), np.minimum(high, region[2:])
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
        if region is not None:
            inside &= (centre >= region[:2]).all(axis=1) & (centre < region[2:]).all(axis=1)
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


def _frames(
    points: Floats, uv: Floats, normals: Floats | None, cell: tuple[float, float], meters_per_uv: float, index: Ints
) -> Placement:
    """Positions, rotations and scales from the triangles in which the cells' centres lie."""
    du, dv = uv[:, 1:, 0] - uv[:, :1, 0], uv[:, 1:, 1] - uv[:, :1, 1]
    determinant = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    edge = points[:, 1:] - points[:, :1]
    dpdu = (edge[:, 0] * dv[:, 1:] - edge[:, 1] * dv[:, :1]) / determinant[:, None]
    dpdv = (edge[:, 1] * du[:, :1] - edge[:, 0] * du[:, 1:]) / determinant[:, None]
    # Barycentric coordinates of the centre.
    q = (index + 0.5) * np.asarray(cell) - uv[:, 0]
    one = (q[:, 0] * dv[:, 1] - q[:, 1] * du[:, 1]) / determinant
    two = (q[:, 1] * du[:, 0] - q[:, 0] * dv[:, 0]) / determinant
    weights = np.stack([1.0 - one - two, one, two], axis=1)
    positions = np.einsum("tc,tcx->tx", weights, points)
    flat = _unit(np.cross(edge[:, 0], edge[:, 1]))
    normal = flat if normals is None else _unit(np.einsum("tc,tcx->tx", weights, normals))
    # Interpolated normals that face away from the triangle are no normals.
    normal = np.where(np.einsum("tx,tx->t", normal, flat)[:, None] > 0, normal, flat)
    x = _unit(dpdu - np.einsum("tx,tx->t", dpdu, normal)[:, None] * normal)
    y = np.cross(normal, x)
    along = np.linalg.norm(dpdu, axis=1) / meters_per_uv
    across = np.abs(np.einsum("tx,tx->t", dpdv, np.cross(flat, _unit(dpdu)))) / meters_per_uv
    scales = np.stack([along, across * np.sign(determinant), np.sqrt(along * across)], axis=1)
    return Placement(positions, np.stack([x, y, normal], axis=2), scales, index)


def _unit(v: Floats) -> Floats:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300)
