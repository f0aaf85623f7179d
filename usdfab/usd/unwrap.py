"""Texture coordinates for cloth that has none: xatlas, in metres, so that yarns have their size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.usd.triangulate import triangulate

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
_CHART_SHARE = (0.005, 0.05)
_CHART_TRIANGLES = 2000
"""A chart is at most this share of the surface: about this many triangles, within the two limits above. Small charts
keep lengths (within 5 % on a sheet with folds; xatlas' own single chart: 40 %), at the price of more seams; and xatlas'
time grows with the square of a chart's triangles."""


def unwrap(points: Array, triangles: Ints) -> Array:
    """(T, 3, 2) texture coordinates in metres for a triangle mesh: charts without much distortion, packed side by side.

    No chart is mirrored: seen from where the triangles run counter-clockwise, so do u and v. The coordinates are
    scaled so that all triangles together have as much area in uv as on the surface. The same input gives the
    same coordinates.

    Parameters
    ----------
    points: (V, 3) metres
    triangles: (T, 3)

    Raises
    ------
    UsdfabError
        If no triangle has an area.
    """
    import xatlas

    corners = points[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    proper = area > 0
    if not proper.any():
        raise UsdfabError("the mesh has no area to unwrap")
    # Near the origin and of size 1, where xatlas' single precision and its thresholds for small lengths are good.
    low, high = corners[proper].min(axis=(0, 1)), corners[proper].max(axis=(0, 1))
    size = float((high - low).max())
    used, local = np.unique(triangles[proper], return_inverse=True)
    atlas = xatlas.Atlas()
    atlas.add_mesh(((points[used] - low) / size).astype(np.float32), local.reshape(-1, 3).astype(np.uint32))
    charts = xatlas.ChartOptions()
    share = float(np.clip(_CHART_TRIANGLES / proper.sum(), *_CHART_SHARE))
    charts.max_chart_area = share * float(area.sum()) / size**2
    options = xatlas.PackOptions()
    # Yarns of all charts lie as the charts do: turning them to pack tighter would gain nothing here.
    options.rotate_charts = False
    options.create_image = False
    atlas.generate(charts, options)
    _, indices, normalized = atlas[0]
    indices = np.asarray(indices, dtype=np.int64)
    flat = _upright(np.asarray(normalized, dtype=np.float64) * [atlas.width, atlas.height], indices)
    uv = np.zeros((len(triangles), 3, 2))
    uv[proper] = flat[indices]
    edges = uv[:, 1:] - uv[:, :1]
    covered = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    if not covered > 0:
        raise UsdfabError("xatlas finds no charts for the mesh")
    return uv * np.sqrt(area.sum() / covered)


def _upright(flat: Array, triangles: Ints) -> Array:
    """(V, 2) coordinates whose charts, which share no vertices, are not mirrored: xatlas makes them either way."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(len(flat),) * 2)
    number, chart = connected_components(links, directed=False)
    a, b = (flat[triangles[:, k]] - flat[triangles[:, 0]] for k in (1, 2))
    area = np.bincount(chart[triangles[:, 0]], a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], minlength=number)
    low, high = np.full(number, np.inf), np.full(number, -np.inf)
    np.minimum.at(low, chart, flat[:, 0])
    np.maximum.at(high, chart, flat[:, 0])
    # About the chart's own middle, so that it stays where it was packed.
    mirrored = (area < 0)[chart]
    u = np.where(mirrored, low[chart] + high[chart] - flat[:, 0], flat[:, 0])
    return np.stack([u, flat[:, 1]], axis=1)


def unwrap_faces(points: Array, counts: Ints, indices: Ints) -> Array:
    """(C, 2) texture coordinates in metres for the corners of polygons, as ``unwrap`` gives them for their triangles.

    A bent polygon whose triangles come to lie apart is put where its largest triangle is, its other corners unfolded
    about the edges of that triangle.
    """
    corners, owner = triangulate(counts, indices, points)
    uv = unwrap(points, indices[corners])
    faces = np.repeat(np.arange(len(counts)), counts)
    at_corner = np.zeros((len(indices), 2))
    # The largest triangle of each face comes last, so that its own corners keep its uv.
    p = points[indices[corners]]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    order = np.argsort(area, kind="stable")
    at_corner[corners[order]] = uv[order]
    leader = np.zeros(len(counts), dtype=np.int64)
    leader[owner[order]] = order
    # Corners of faces whose triangles disagree about any of them.
    apart = np.abs(at_corner[corners] - uv).max(axis=(1, 2)) > 1e-9 * max(float(np.abs(uv).max()), 1e-300)
    torn = np.isin(faces, owner[apart])
    main = leader[faces[torn]]
    weights = _unfolded(p[main], points[indices[torn]])
    at_corner[torn] = np.einsum("nk,nkc->nc", weights, uv[main])
    return at_corner


def _unfolded(triangle: Array, point: Array) -> Array:
    """(N, 3) barycentric coordinates of points turned into the planes of triangles (N, 3, 3) about the nearest edge."""
    e1, e2, d = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0], point - triangle[:, 0]
    a, b, c, x, y = (np.einsum("ij,ij->i", v, w) for v, w in ((e1, e1), (e1, e2), (e2, e2), (d, e1), (d, e2)))
    determinant = np.maximum(a * c - b * b, 1e-300)
    s, t = (c * x - b * y) / determinant, (a * y - b * x) / determinant
    weights = np.stack([1.0 - s - t, s, t], axis=1)
    # The edge that the point lies beyond, across from the corner with the least weight: the distance from it counts.
    row, corner = np.arange(len(point)), weights.argmin(axis=1)
    start, end = triangle[row, (corner + 1) % 3], triangle[row, (corner + 2) % 3]
    edge = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1, keepdims=True), 1e-300)
    away, height = (v - start - np.einsum("ij,ij->i", v - start, edge)[:, None] * edge
                    for v in (point, triangle[row, corner]))  # fmt: skip
    wanted = -np.linalg.norm(away, axis=1) / np.maximum(np.linalg.norm(height, axis=1), 1e-300)
    change = wanted - weights[row, corner]
    # Along the edge the point stays where it is: the height's own foot moves with its weight.
    along = np.einsum("ij,ij->i", triangle[row, corner] - start, edge) / np.maximum(
        np.linalg.norm(end - start, axis=1), 1e-300
    )
    weights[row, corner] = wanted
    weights[row, (corner + 2) % 3] -= change * along
    weights[row, (corner + 1) % 3] -= change * (1.0 - along)
    return weights
