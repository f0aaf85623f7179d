"""The macro scale: meshes and their placed copies as one Embree scene, with what the kernels need at each corner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.tracer.embree import EmbreeScene, add_triangles
from usdfab.tracer.world import FABRIC_COLUMNS, Macro
from usdfab.usd.corner_frames import cloth_gradients, face_geometry, smooth_normals
from usdfab.usd.scene import Mesh, Scene


class Tiles(NamedTuple):
    """Where a fabric's tiles are: row of the first in ``Patches.table``, number of variants."""

    first: int
    variants: int


def build_macro(scene: Scene, tiles: Sequence[Tiles], albedo_maps: Sequence[int]) -> tuple[Macro, EmbreeScene]:
    """Arrays and Embree scene of a scene's meshes.

    Parameters
    ----------
    tiles, albedo_maps:
        For each of ``scene.fabrics``: its tiles; the number of the texture that multiplies its albedo, or -1.
    """
    meshes = scene.meshes
    if not meshes:
        raise UsdfabError("the stage has no visible mesh", place=scene.path, remedy="add a Mesh or check visibility")
    keys = 2 if any(_moves(mesh) for mesh in meshes) else 1
    parts = [_mesh_arrays(mesh, _uv_scale(scene, mesh), keys) for mesh in meshes]
    first = np.r_[0, np.cumsum([len(m.triangles) for m in meshes])]
    fabrics = np.full((len(scene.materials), FABRIC_COLUMNS), -1.0)
    for row, material in zip(fabrics, scene.materials, strict=True):
        if material.fabric >= 0:
            own = tiles[material.fabric]
            row[:] = own.first, own.variants, scene.fabrics[material.fabric].meters_per_uv, albedo_maps[material.fabric]
    tinted, tint = _tints(meshes)
    embree, placements, copies, bounds = _build(meshes, keys, first)
    macro = Macro(
        corners=np.concatenate([p[0] for p in parts], axis=1),
        faces=np.concatenate([p[1] for p in parts], axis=1),
        uv=np.concatenate([p[2] for p in parts]),
        tint=tint,
        tinted=tinted,
        material=np.concatenate([m.face_material for m in meshes]).astype(np.int32),
        mesh=np.repeat(np.arange(len(meshes)), np.diff(first)).astype(np.int32),
        fabrics=fabrics,
        placements=placements,
        first=copies,
        bounds=bounds,
        meshes=len(meshes),
    )
    return macro, embree


def _build(
    meshes: Sequence[Mesh], keys: int, first: NDArray
) -> tuple[EmbreeScene, NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
    """(scene, placements (keys, I, 3, 4), first triangle of each copy (I,), bounds (2, 3)).

    Copies come first in the scene, then one geometry of all triangles that lie in the world.
    """
    scene = EmbreeScene()
    placements, copies, clouds = [], [], []
    for mesh, start in zip(meshes, first[:-1], strict=True):
        if mesh.placements is None:
            continue
        points = _points(mesh, keys)
        prototype = EmbreeScene()
        # A prototype that moves in itself and is placed at several times: Embree blends both.
        add_triangles(prototype, points, mesh.triangles)
        prototype.commit()
        close = mesh.placements if mesh.placements_close is None else mesh.placements_close
        placed = np.stack([mesh.placements, close][:keys])
        corners = _box(points)
        for k in range(placed.shape[1]):
            scene.add_instance(prototype, placed[:, k])
            for matrix in placed[:, k]:
                clouds.append(corners @ matrix[:, :3].T + matrix[:, 3])
        placements.append(placed)
        copies.append(np.full(placed.shape[1], start, dtype=np.int32))
    here = [(m, s) for m, s in zip(meshes, first[:-1], strict=True) if m.placements is None]
    if here:
        # Triangles of meshes with copies keep their numbers: they are left without area, which Embree skips.
        triangles = np.zeros((int(first[-1]), 3), dtype=np.int64)
        vertices, base = [np.zeros((keys, 1, 3))], 1
        for mesh, start in here:
            triangles[start : start + len(mesh.triangles)] = mesh.triangles + base
            vertices.append(_points(mesh, keys))
            clouds.append(_box(vertices[-1]))
            base += len(mesh.points)
        add_triangles(scene, np.concatenate(vertices, axis=1), triangles)
    cloud = np.concatenate(clouds)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    margin = 1e-5 * float(np.abs(np.r_[low, high, high - low]).max()) + 1e-9
    return (
        scene.commit(),
        np.concatenate([np.zeros((keys, 0, 3, 4)), *placements], axis=1),
        np.concatenate([np.zeros(0, dtype=np.int32), *copies]),
        np.stack([low - margin, high + margin]),
    )


def _moves(mesh: Mesh) -> bool:
    """Whether anything of a mesh is elsewhere when the shutter closes."""
    if mesh.points_close is not None and not np.array_equal(mesh.points, mesh.points_close):
        return True
    placed, close = mesh.placements, mesh.placements_close
    return placed is not None and close is not None and not np.array_equal(placed, close)


def _points(mesh: Mesh, keys: int) -> NDArray[np.float64]:
    """(keys, V, 3)."""
    close = mesh.points if mesh.points_close is None else mesh.points_close
    return np.stack([mesh.points, close][:keys])


def _box(points: NDArray) -> NDArray[np.float64]:
    """(8, 3) corners of the box around points (keys, V, 3)."""
    ends = np.stack([points.min(axis=(0, 1)), points.max(axis=(0, 1))])
    return np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)


def _tints(meshes: Sequence[Mesh]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """(row of the tints or -1 for each triangle, tints (N, 3, 3))."""
    rows, tints, count = [], [np.ones((0, 3, 3))], 0
    for mesh in meshes:
        triangles = len(mesh.triangles)
        if mesh.albedo is None:
            rows.append(np.full(triangles, -1))
        else:
            rows.append(np.arange(count, count + triangles))
            tints.append(np.asarray(mesh.albedo))
            count += triangles
    return np.concatenate(rows).astype(np.int32), np.concatenate(tints).astype(np.float32)


def _uv_scale(scene: Scene, mesh: Mesh) -> NDArray[np.float64]:
    """(T,) metres of cloth per unit of uv, 1 on faces without fabric."""
    fabric = np.array([m.fabric for m in scene.materials], dtype=int)[mesh.face_material]
    scales = np.array([f.meters_per_uv for f in scene.fabrics] + [1.0])
    return scales[fabric]  # -1 picks the last entry


def _mesh_arrays(
    mesh: Mesh, uv_scale: NDArray, keys: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """(corners (keys, T, 3, 9), unit normals (keys, T, 3), uv (T, 3, 2)) of one mesh."""
    count = len(mesh.triangles)
    raw = np.zeros((count, 3, 2)) if mesh.uv is None else np.asarray(mesh.uv, dtype=float)
    uv = raw * uv_scale[:, None, None]
    corners = np.zeros((keys, count, 3, 9), dtype=np.float32)
    faces = np.zeros((keys, count, 3), dtype=np.float32)
    opened = None
    for key, points in enumerate(_points(mesh, keys)):
        edges, geometric, double_area = face_geometry(points[mesh.triangles])
        cross = np.cross(*edges)
        if mesh.normals is None:
            normals = np.repeat(geometric[:, None], 3, axis=1)
        elif key == 0:
            normals = np.asarray(mesh.normals)
        else:
            # Authored normals turn as the smooth normals of the points do.
            assert opened is not None
            normals = np.asarray(mesh.normals) + smooth_normals(mesh, cross) - opened
        if key == 0 and keys == 2 and mesh.normals is not None:
            opened = smooth_normals(mesh, cross)
        faces[key] = geometric
        corners[key, ..., :3] = normals
        corners[key, ..., 3:] = cloth_gradients(mesh, edges, geometric, double_area, uv)
    return corners, faces, raw
