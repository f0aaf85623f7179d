"""Polygons to triangles, concave ones included. NumPy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def triangulate(counts: Ints, indices: Ints, points: Floats) -> tuple[Ints, Ints]:
    """Triangles of a polygon mesh.

    Parameters
    ----------
    counts: (F,) int
        Corners of each face; faces of fewer than three corners make no triangle.
    indices: (sum of counts,) int
        Point of each corner.
    points: (V, 3)

    Returns
    -------
    corners: (T, 3) int
        Positions in ``indices`` (so that face-varying data can be looked up), in the face's own winding.
    faces: (T,) int
        The face each triangle comes from. Triangles are sorted by face.

    Quads are split along the diagonal that keeps both halves facing the quad's own way, larger polygons by ear
    clipping in the plane of their area vector. The triangles of a planar simple polygon cover exactly its area.
    """
    counts = np.asarray(counts, dtype=np.int64)
    indices = np.asarray(indices, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else np.zeros(0, dtype=np.int64)
    corners, faces = [], []
    three = np.flatnonzero(counts == 3)
    corners.append(starts[three][:, None] + np.arange(3))
    faces.append(three)
    four = np.flatnonzero(counts == 4)
    if len(four):
        corners.append(_split_quads(starts[four], indices, points))
        faces.append(np.repeat(four, 2))
    for face in np.flatnonzero(counts > 4):
        local = _clip_ears(points[indices[starts[face] : starts[face] + counts[face]]])
        corners.append(starts[face] + local)
        faces.append(np.full(len(local), face))
    all_corners, all_faces = np.concatenate(corners), np.concatenate(faces)
    order = np.argsort(all_faces, kind="stable")
    return all_corners[order], all_faces[order]


def _split_quads(starts: Ints, indices: Ints, points: Floats) -> Ints:
    """(2 Q, 3) corners; the diagonal 0-2 unless one of its halves would be turned over."""
    p = points[indices[starts[:, None] + np.arange(4)]]
    area = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    first = np.einsum("ij,ij->i", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), area)
    second = np.einsum("ij,ij->i", np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 0]), area)
    flip = np.minimum(first, second) < 0
    local = np.where(flip[:, None], [0, 1, 3, 1, 2, 3], [0, 1, 2, 0, 2, 3])
    return (starts[:, None] + local).reshape(-1, 3)


def _clip_ears(p: Floats) -> Ints:
    """(n - 2, 3) triangles of one polygon, corners counted from 0."""
    n = len(p)
    relative = p - p[0]
    area = np.cross(relative, np.roll(relative, -1, axis=0)).sum(axis=0)
    drop = int(np.argmax(np.abs(area)))
    keep = [(1, 2), (2, 0), (0, 1)][drop]
    flat = relative[:, keep] * (1.0 if area[drop] >= 0 else np.array([1.0, -1.0]))
    remaining = list(range(n))
    triangles = []
    while len(remaining) > 3:
        ear = _best_ear(flat[remaining])
        triangles.append([remaining[ear - 1], remaining[ear], remaining[(ear + 1) % len(remaining)]])
        del remaining[ear]
    triangles.append(remaining)
    return np.asarray(triangles, dtype=np.int64)


def _best_ear(q: NDArray[np.float64]) -> int:
    """Of a counter-clockwise polygon's corners, the convex one that holds no other corner and is least pointed."""
    before, after = np.roll(q, 1, axis=0), np.roll(q, -1, axis=0)
    turn = _cross(q - before, after - q)
    lengths = np.linalg.norm(q - before, axis=1) * np.linalg.norm(after - q, axis=1)
    sine = turn / np.maximum(lengths, 1e-300)
    for ear in np.argsort(-sine, kind="stable"):
        if turn[ear] < 0:
            break
        a, b, c = before[ear], q[ear], after[ear]
        inside = (_cross(b - a, q - a) >= 0) & (_cross(c - b, q - b) >= 0) & (_cross(a - c, q - c) >= 0)
        # The ear's own corners do not count, nor do points that coincide with them (polygons with a bridge).
        own = (q == a).all(axis=1) | (q == b).all(axis=1) | (q == c).all(axis=1)
        if not (inside & ~own).any():
            return int(ear)
    # Not a simple polygon: any corner will do, the area is undefined anyway.
    return int(np.argmax(sine))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
