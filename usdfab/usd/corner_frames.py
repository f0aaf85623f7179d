"""What a fabric needs at the corners of a mesh's triangles: normals, and how the cloth lies on the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.scene import Mesh


def face_geometry(corners: NDArray) -> tuple[tuple[NDArray, NDArray], NDArray, NDArray]:
    """((edges from the first corner (T, 3) twice), unit normals (T, 3), twice the areas (T,)) of triangles (T, 3, 3).

    Triangles without area get +z and an area of 1, so that their numbers stay finite; no ray meets them.
    """
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(*edges)
    double_area = np.linalg.norm(cross, axis=1)
    proper = double_area > 0.0
    double_area[~proper] = 1.0
    normal = cross / double_area[:, None]
    normal[~proper] = 0.0, 0.0, 1.0
    return edges, normal, double_area


def smooth_normals(mesh: Mesh, cross: NDArray) -> NDArray[np.float64]:
    """(T, 3, 3) unit normals at the corners, averaged by area over the triangles at a point."""
    total = np.zeros_like(mesh.points)
    for corner in range(3):
        np.add.at(total, mesh.triangles[:, corner], cross)
    smooth = total[mesh.triangles]
    return smooth / np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-30)


def cloth_gradients(
    mesh: Mesh, edges: tuple[NDArray, NDArray], normal: NDArray, double_area: NDArray, uv: NDArray
) -> NDArray[np.float64]:
    """(T, 3, 6) gradients of the cloth's x and y at the corners, averaged over the triangles at a vertex unless they
    disagree there (uv seams)."""
    du, dv = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    # grad f = ((f1 - f0) (e2 x n) + (f2 - f0) (n x e1)) / (2 A) for a linear f on a triangle with e1 x e2 = 2 A n.
    across = np.cross(edges[1], normal), np.cross(normal, edges[0])
    gradient = (du[:, :, None] * across[0][:, None] + dv[:, :, None] * across[1][:, None]) / double_area[:, None, None]
    flat = np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]) <= 1e-20
    if flat.any():  # no Jacobian: the cloth lies there along the first edge, in its own size
        along = edges[0][flat] / np.maximum(np.linalg.norm(edges[0][flat], axis=1, keepdims=True), 1e-30)
        gradient[flat] = np.stack([along, np.cross(normal[flat], along)], axis=1)
    gradient = gradient.reshape(-1, 6)
    if mesh.normals is None:
        return np.repeat(gradient[:, None], 3, axis=1)
    total = np.zeros((len(mesh.points), 7))
    # Faces without area, and those whose uv say nothing, have no part in their neighbours' cloth.
    weight = np.where(flat, 0.0, np.linalg.norm(np.cross(*edges), axis=1))
    weighted = np.c_[gradient, np.ones(len(gradient))] * weight[:, None]
    for corner in range(3):
        np.add.at(total, mesh.triangles[:, corner], weighted)
    smooth = (total[:, :6] / np.maximum(total[:, 6:], 1e-30))[mesh.triangles]
    agrees = np.ones(smooth.shape[:2], dtype=bool)
    for part in (slice(0, 3), slice(3, 6)):
        a, b = smooth[..., part], gradient[:, None, part]
        scale = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
        agrees &= np.sum(a * b, axis=-1) > 0.7 * scale
        agrees &= np.linalg.norm(a, axis=-1) > 0.7 * np.linalg.norm(b, axis=-1)
    return np.where(agrees[..., None], smooth, gradient[:, None])
