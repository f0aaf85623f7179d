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

    They are scaled so that all triangles together have as much area in uv as on the surface. The same input gives the
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
    flat = np.asarray(normalized, dtype=np.float64) * [atlas.width, atlas.height]
    uv = np.zeros((len(triangles), 3, 2))
    uv[proper] = flat[np.asarray(indices, dtype=np.int64)]
    edges = uv[:, 1:] - uv[:, :1]
    covered = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    if not covered > 0:
        raise UsdfabError("xatlas finds no charts for the mesh")
    return uv * np.sqrt(area.sum() / covered)


def unwrap_faces(points: Array, counts: Ints, indices: Ints) -> Array:
    """(C, 2) texture coordinates in metres for the corners of polygons, as ``unwrap`` gives them for their triangles.

    A bent polygon whose triangles come to lie apart is put where its largest triangle is, its other corners by the map
    of that triangle.
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
    e1, e2 = p[main, 1] - p[main, 0], p[main, 2] - p[main, 0]
    d = points[indices[torn]] - p[main, 0]
    a, b, c = (np.einsum("ij,ij->i", x, y) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    x, y = np.einsum("ij,ij->i", d, e1), np.einsum("ij,ij->i", d, e2)
    determinant = np.maximum(a * c - b * b, 1e-300)
    s, t = (c * x - b * y) / determinant, (a * y - b * x) / determinant
    base = uv[main, 0]
    at_corner[torn] = base + s[:, None] * (uv[main, 1] - base) + t[:, None] * (uv[main, 2] - base)
    return at_corner
