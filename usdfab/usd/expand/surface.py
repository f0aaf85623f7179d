"""A piece of cloth as a map from the cloth's own plane to the world: charts, point location, frames. NumPy only.

A place on the cloth is (x, y) in metres, x along the weft, y along the warp: texture coordinates times metres per uv.
A chart is a set of triangles that hang together in that plane, all wound the same way; its border is where the mesh
ends, where texture coordinates jump (a seam), where they are mirrored, and where another material begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from usdfab.usd.scene import FabricSurface, Mesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CHUNK = 2_000_000
_FARTHEST = 1e6
"""Places of the cloth farther out than this, metres, are no sensible texture coordinates and are left out."""

_SLACK = 1e-9
"""How far outside, as a share of a triangle, a point still counts as inside it."""


@dataclass(frozen=True, eq=False)
class Places:
    """N places on a surface.

    ``points`` (N, 3) metres; ``normals`` (N, 3) unit; ``rise`` (N,) metres of world per metre of cloth along the
    normal; ``uv`` (N, 2) texture coordinates; ``tint`` (N, 3) the mesh's colours, 1 where it has none.
    """

    points: Floats
    normals: Floats
    rise: Floats
    uv: Floats
    tint: Floats


class ClothSurface:
    """Triangles of a mesh that wear one fabric.

    Attributes
    ----------
    points: (T, 3, 3) metres, xy: (T, 3, 2) metres of cloth
        Corners, counter-clockwise seen from the front.
    along, across: (T, 3)
        World per metre of cloth along x and y (dp/dx, dp/dy).
    flat, normals: (T, 3), (T, 3, 3)
        Unit normals of the triangles, and at their corners.
    chart: (T,)
        Number of the chart.
    border: (B,) int, (B,) int
        Triangle and edge (from corner k to k + 1) of each edge at which a chart ends.
    """

    def __init__(self, mesh: Mesh, surface: FabricSurface, faces: NDArray[np.bool_], copy: int | None = None) -> None:
        """``faces`` (T,): which triangles; ``copy``: which of the mesh's placements, None where it has none."""
        assert mesh.uv is not None, "a mesh with a fabric has uv"
        xy = mesh.uv * surface.meters_per_uv
        a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
        determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        points = mesh.points[mesh.triangles]
        normals = mesh.normals
        if copy is not None:
            assert mesh.placements is not None
            linear, shift = mesh.placements[copy][:, :3], mesh.placements[copy][:, 3]
            points = points @ linear.T + shift
            normals = None if normals is None else unit(normals @ np.linalg.inv(linear))
        cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        area = np.linalg.norm(cross, axis=1)
        size = np.maximum(np.abs(a).sum(axis=1), np.abs(b).sum(axis=1))
        # Triangles that cover no cloth, or of which no surface is left, carry no fibers.
        near = np.abs(xy).max(axis=(1, 2), initial=0.0) < _FARTHEST
        keep = faces & near & (np.abs(determinant) > 1e-12 * size**2) & (area > 0.0)
        self.xy, self.points, self.uv = xy[keep], points[keep], mesh.uv[keep]
        self.albedo = None if mesh.albedo is None else mesh.albedo[keep]
        a, b, determinant = a[keep], b[keep], determinant[keep]
        edge = self.points[:, 1:] - self.points[:, :1]
        self.along = (edge[:, 0] * b[:, 1:] - edge[:, 1] * a[:, 1:]) / determinant[:, None]
        self.across = (edge[:, 1] * a[:, :1] - edge[:, 0] * b[:, :1]) / determinant[:, None]
        self.flat = cross[keep] / area[keep, None]
        if normals is None:
            self.normals = np.repeat(self.flat[:, None], 3, axis=1)
        else:
            self.normals = normals[keep]
        self.mirrored = determinant < 0
        self._inverse = np.stack([b[:, 1], -b[:, 0], -a[:, 1], a[:, 0]], axis=1) / determinant[:, None]
        corner = _corners(mesh.triangles[keep], self.xy, self.mirrored)
        self.chart, self.border = _charts(corner)
        square = area[keep] / np.abs(determinant)
        self.rise = _averaged(corner, square, area[keep])
        self._grid = _Grid(self.xy, self.chart)

    def __len__(self) -> int:
        return len(self.xy)

    def locate(self, chart: Ints, xy: Floats, near: Floats | None = None) -> tuple[Ints, Floats]:
        """The triangle of a chart in which each place lies, or -1, and barycentric coordinates.

        Parameters
        ----------
        chart: (N,), xy: (N, 2) metres of cloth
        near: (N, 3) metres
            Where a chart covers a place more than once, that nearest to this is taken; else the first.

        Returns
        -------
        triangle: (N,), weights: (N, 3)
        """
        triangle = np.full(len(xy), -1, dtype=np.int64)
        weights = np.zeros((len(xy), 3))
        for query, candidate in self._grid.candidates(chart, xy):
            found = self.weights(candidate, xy[query])
            inside = found.min(axis=1) >= -_SLACK
            query, candidate, found = query[inside], candidate[inside], found[inside]
            if near is not None and len(query):
                place = np.einsum("tc,tcx->tx", found, self.points[candidate])
                order = np.lexsort((np.linalg.norm(place - near[query], axis=1), query))
                query, candidate, found = query[order], candidate[order], found[order]
            first = np.ones(len(query), dtype=bool)
            first[1:] = query[1:] != query[:-1]
            triangle[query[first]], weights[query[first]] = candidate[first], found[first]
        return triangle, weights

    def at(self, triangle: Ints, weights: Floats) -> Places:
        """What lies at places in triangles; weights may lie outside, triangles then go on as planes."""
        points = np.einsum("tc,tcx->tx", weights, self.points[triangle])
        clipped = np.clip(weights, 0.0, 1.0)
        clipped = clipped / clipped.sum(axis=1, keepdims=True)
        flat = self.flat[triangle]
        normals = unit(np.einsum("tc,tcx->tx", clipped, self.normals[triangle]))
        # Interpolated normals that face away from the triangle are no normals.
        normals = np.where(np.einsum("tx,tx->t", normals, flat)[:, None] > 0.1, normals, flat)
        tint = np.ones((len(triangle), 3))
        if self.albedo is not None:
            tint = np.einsum("tc,tcx->tx", clipped, self.albedo[triangle])
        return Places(
            points,
            normals,
            np.sqrt(np.einsum("tc,tc->t", clipped, self.rise[triangle])),
            np.einsum("tc,tcx->tx", weights, self.uv[triangle]),
            tint,
        )

    def weights(self, triangle: Ints, xy: Floats) -> Floats:
        """(N, 3) barycentric coordinates of places (N, 2); not bounded, triangles go on as planes."""
        q, inverse = xy - self.xy[triangle, 0], self._inverse[triangle]
        one = q[:, 0] * inverse[:, 0] + q[:, 1] * inverse[:, 1]
        two = q[:, 0] * inverse[:, 2] + q[:, 1] * inverse[:, 3]
        return np.stack([1.0 - one - two, one, two], axis=1)


def unit(v: Floats) -> Floats:
    """Vectors of length 1; zero stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300)


def _corners(triangles: NDArray, xy: Floats, mirrored: NDArray[np.bool_]) -> Ints:
    """(T, 3) one number for each point with its place on the cloth and its side."""
    side = np.repeat(mirrored.astype(float), 3)
    rows = np.column_stack([triangles.ravel().astype(float), xy.reshape(-1, 2), side])
    # -0.0 and 0.0 are the same place.
    keys = np.ascontiguousarray(rows + 0.0).view(np.dtype((np.void, rows.dtype.itemsize * 4))).ravel()
    return np.unique(keys, return_inverse=True)[1].reshape(-1, 3).astype(np.int64)


def _charts(corner: Ints) -> tuple[Ints, tuple[Ints, Ints]]:
    """(T,) number of the chart, and (triangle, edge) of its borders."""
    count = len(corner)
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge, users = np.unique(low * (corner.max(initial=0) + 1) + high, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    triangle = np.repeat(np.arange(count), 3)
    links = coo_matrix((np.ones(3 * count), (triangle, count + edge)), shape=(count + len(users),) * 2)
    chart = connected_components(links, directed=False)[1][:count].astype(np.int64)
    single = np.flatnonzero(users[edge] == 1)
    return chart, (single // 3, single % 3)


def _averaged(corner: Ints, values: Floats, weights: Floats) -> Floats:
    """(T, 3) values of triangles averaged at their corners."""
    number = int(corner.max(initial=-1)) + 1
    flat = corner.ravel()
    total = np.bincount(flat, np.repeat(values * weights, 3), number)
    weight = np.bincount(flat, np.repeat(weights, 3), number)
    return (total / np.maximum(weight, 1e-300))[corner]


class _Grid:
    """Triangles by the square cells of the cloth's plane that their boxes touch."""

    def __init__(self, xy: Floats, chart: Ints) -> None:
        low, high = xy.min(axis=1), xy.max(axis=1)
        box = (high - low).prod(axis=1)
        # Half a box: fewer triangles that do not hold the place, for twice the memory.
        # Slivers must not fill it.
        longest = (high - low).max(axis=1, initial=0.0)
        self.side = max(0.5 * float(np.sqrt(box.mean())), float(longest.mean()) / 16.0) if len(xy) else 1.0
        self.origin = low.min(axis=0) if len(xy) else np.zeros(2)
        first, last = self._cell(low), self._cell(high)
        self.shape = last.max(axis=0) + 1 if len(xy) else np.ones(2, dtype=np.int64)
        wide = last - first + 1
        number = wide.prod(axis=1)
        triangle = np.repeat(np.arange(len(xy)), number)
        within = np.arange(len(triangle)) - np.repeat(np.cumsum(number) - number, number)
        columns = wide[triangle, 0]
        cell = first[triangle] + np.stack([within % columns, within // columns], axis=1)
        key = self._key(chart[triangle], cell)
        order = np.argsort(key, kind="stable")
        self.keys, self.triangles = key[order], triangle[order]

    def _cell(self, xy: Floats) -> Ints:
        return np.floor((xy - self.origin) / self.side).astype(np.int64)

    def _key(self, chart: Ints, cell: Ints) -> Ints:
        return (chart * self.shape[0] + cell[:, 0]) * self.shape[1] + cell[:, 1]

    def candidates(self, chart: Ints, xy: Floats) -> Iterator[tuple[Ints, Ints]]:
        """(number of the place, triangle) of what may hold it, some places at a time, in their order."""
        cell = self._cell(np.clip(xy, -1e12, 1e12))
        valid = np.all((cell >= 0) & (cell < self.shape), axis=1)
        key = np.where(valid, self._key(chart, np.where(valid[:, None], cell, 0)), -1)
        start, stop = np.searchsorted(self.keys, key, "left"), np.searchsorted(self.keys, key, "right")
        number = stop - start
        total = np.cumsum(number)
        used = np.flatnonzero(number)
        for part in np.split(used, np.flatnonzero(np.diff(total[used] // _CHUNK)) + 1):
            query = np.repeat(part, number[part])
            within = np.arange(len(query)) - np.repeat(np.cumsum(number[part]) - number[part], number[part])
            yield query, self.triangles[start[query] + within]
