"""The macro scale: meshes as one Embree scene, with what the kernels need at each corner."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.tracer.embree import EmbreeScene, triangle_scene
from usdfab.usd.scene import Mesh, Scene


class Macro(NamedTuple):
    """Triangles of all meshes, arrays over T triangles. World space, metres.

    ``points``, ``normals``, ``tangents`` (T, 3, 3) and ``uv`` (T, 3, 2) belong to corners. ``tangents`` point where the
    patch's x axis (weft) runs; ``uv`` is the place in the patch in metres of cloth. ``scale`` is metres of cloth per
    metre of world, ``sign`` -1 where uv is mirrored. ``material`` indexes ``surfaces``; ``mesh`` numbers the meshes.
    """

    points: NDArray[np.float64]
    geometric: NDArray[np.float64]
    normals: NDArray[np.float64]
    tangents: NDArray[np.float64]
    uv: NDArray[np.float64]
    scale: NDArray[np.float64]
    sign: NDArray[np.float64]
    material: NDArray[np.int32]
    mesh: NDArray[np.int32]
    surfaces: NDArray[np.float64]
    """(materials, 4): index of the patch or -1, base colour."""


def build_macro(scene: Scene, patch_of_fabric: list[int]) -> tuple[Macro, EmbreeScene, tuple[NDArray, float]]:
    """Arrays and Embree scene of a scene's meshes, and (centre, half diagonal) of their bounds.

    ``patch_of_fabric`` says which patch each of ``scene.fabrics`` uses.
    """
    if not scene.meshes:
        raise UsdfabError("the stage has no visible mesh", place=scene.path, remedy="add a Mesh or check visibility")
    parts = [_mesh_arrays(mesh, _uv_scale(scene, mesh), index) for index, mesh in enumerate(scene.meshes)]
    joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    surfaces = np.zeros((len(scene.materials), 4))
    for row, material in zip(surfaces, scene.materials, strict=True):
        row[0] = patch_of_fabric[material.fabric] if material.fabric >= 0 else -1.0
        row[1:] = material.base_color
    macro = Macro(*joined, surfaces)  # type: ignore[call-arg]
    points = macro.points.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    embree = triangle_scene(points, np.arange(len(points)).reshape(-1, 3))
    return macro, embree, (0.5 * (low + high), float(0.5 * np.linalg.norm(high - low)))


def _uv_scale(scene: Scene, mesh: Mesh) -> NDArray[np.float64]:
    """(T,) metres of cloth per unit of uv, 1 on faces without fabric."""
    fabric = np.array([m.fabric for m in scene.materials], dtype=int)[mesh.face_material]
    scales = np.array([f.meters_per_uv for f in scene.fabrics] + [1.0])
    return scales[fabric]  # -1 picks the last entry


def _mesh_arrays(mesh: Mesh, uv_scale: NDArray, index: int) -> tuple[NDArray, ...]:
    corners = mesh.points[mesh.triangles]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(edge1, edge2)
    double_area = np.linalg.norm(cross, axis=1)
    proper = double_area > 0.0
    if not proper.all():  # Embree never reports triangles without area; keep their numbers finite
        cross[~proper], double_area[~proper] = (0.0, 0.0, 1.0), 1.0
    geometric = cross / double_area[:, None]
    normals = np.broadcast_to(geometric[:, None], corners.shape) if mesh.normals is None else mesh.normals
    count = len(corners)
    uv = np.zeros((count, 3, 2)) if mesh.uv is None else mesh.uv * uv_scale[:, None, None]
    du, dv = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    determinant = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    safe = np.where(np.abs(determinant) > 1e-20, determinant, 1.0)
    dpdu = (edge1 * dv[:, 1:] - edge2 * du[:, 1:]) / safe[:, None]
    flat = np.abs(determinant) <= 1e-20
    dpdu[flat] = edge1[flat]
    scale = np.where(flat, 1.0, np.sqrt(np.abs(determinant) / double_area))
    sign = np.where(determinant < 0.0, -1.0, 1.0)
    tangents = _smooth_tangents(mesh, dpdu, double_area)
    material = mesh.face_material.astype(np.int32)
    return corners, geometric, normals, tangents, uv, scale, sign, material, np.full(count, index, dtype=np.int32)


def _smooth_tangents(mesh: Mesh, dpdu: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """(T, 3, 3) dp/du at the corners, averaged over the triangles at a vertex unless they disagree (uv seams)."""
    unit = dpdu / np.maximum(np.linalg.norm(dpdu, axis=1, keepdims=True), 1e-30)
    if mesh.normals is None:
        return np.repeat(unit[:, None], 3, axis=1)
    total = np.zeros_like(mesh.points)
    for corner in range(3):
        np.add.at(total, mesh.triangles[:, corner], unit * weight[:, None])
    smooth = total[mesh.triangles]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-30)
    agrees = np.einsum("tcx,tx->tc", smooth, unit) > 0.7
    return np.where(agrees[..., None], smooth, unit[:, None])
