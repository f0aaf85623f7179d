"""All triangles that wear a fabric, copies included, as one list: what a ray that meets them needs to know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.corner_frames import cloth_gradients, face_geometry
from usdfab.usd.scene import Mesh, Scene

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ClothTriangles:
    """Triangles in the world, metres.

    Parameters
    ----------
    corners: (T, 3, 3)
    normal: (T, 3)
        Unit normal of the triangle.
    frames: (T, 3, 9)
        At the corners: shading normal, gradients of the cloth's x and y (metres of cloth per metre).
    uv: (T, 3, 2)
        Texture coordinates.
    tint: (T, 3, 3)
        Factors of the fiber albedo; ones where the mesh has none.
    fabric, mesh: (T,)
        Index into ``Scene.fabrics``; number of the mesh, each copy one of its own.
    tinted:
        Whether any mesh has factors.
    """

    corners: Floats
    normal: Floats
    frames: Floats
    uv: Floats
    tint: Floats
    fabric: NDArray[np.int64]
    mesh: NDArray[np.int64]
    tinted: bool

    def __len__(self) -> int:
        return len(self.fabric)


def cloth_triangles(scene: Scene) -> ClothTriangles:
    """The triangles of a scene that wear fabrics."""
    worn = np.array([m.fabric for m in scene.materials], dtype=int)
    parts: list[tuple[NDArray, ...]] = []
    number = 0
    for mesh in scene.meshes:
        fabric = worn[mesh.face_material]
        chosen = fabric >= 0
        copies = [None] if mesh.placements is None else list(mesh.placements)
        if chosen.any() and mesh.uv is not None:
            scale = np.array([f.meters_per_uv for f in scene.fabrics] + [1.0])[fabric]
            own = _of_mesh(mesh, scale)
            for copy, matrix in enumerate(copies):
                if matrix is not None and np.linalg.matrix_rank(matrix[:, :3]) < 3:
                    continue  # scaled to nothing: no ray meets it
                corners, normal, frames = own if matrix is None else _placed(*own, matrix)
                tint = np.ones_like(corners) if mesh.albedo is None else np.asarray(mesh.albedo, dtype=float)
                ids = np.full(len(fabric), number + copy)
                parts.append(tuple(a[chosen] for a in (corners, normal, frames, mesh.uv, tint, fabric, ids)))
        number += len(copies)
    empty = [np.zeros((0, *shape)) for shape in ((3, 3), (3,), (3, 9), (3, 2), (3, 3), (), ())]
    corners, normal, frames, uv, tint, fabric, ids = (
        np.concatenate([none, *columns]) for none, *columns in zip(empty, *parts, strict=True)
    )
    return ClothTriangles(
        corners, normal, frames, uv, tint, fabric.astype(np.int64), ids.astype(np.int64),
        any(m.albedo is not None for m in scene.meshes),
    )  # fmt: skip


def _of_mesh(mesh: Mesh, scale: Floats) -> tuple[Floats, Floats, Floats]:
    """(corners, normal, frames) of all triangles of a mesh, in its own space; ``scale`` (T,) metres per unit of uv."""
    assert mesh.uv is not None
    corners = mesh.points[mesh.triangles]
    edges, normal, double_area = face_geometry(corners)
    shading = np.repeat(normal[:, None], 3, axis=1) if mesh.normals is None else np.asarray(mesh.normals, dtype=float)
    gradients = cloth_gradients(mesh, edges, normal, double_area, mesh.uv * scale[:, None, None])
    return corners, normal, np.concatenate([shading, gradients], axis=2)


def _placed(corners: Floats, normal: Floats, frames: Floats, matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """The same of a copy. The cloth is fixed to it: yarns grow with a copy that is larger."""
    linear = matrix[:, :3]
    # Normals and gradients are covectors.
    inverse = np.linalg.inv(linear)
    turned = normal @ inverse
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300)
    covectors = frames.reshape(len(frames), 3, 3, 3) @ inverse
    return corners @ linear.T + matrix[:, 3], turned, covectors.reshape(frames.shape)
