"""Triangles of a local space as meshes of the world: one copy at a time, or many as placements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.scene import Array, IntArray
from usdfab.usd.tessellate import Triangles


@dataclass(frozen=True, eq=False)
class Baked:
    """Geometry of a :class:`~usdfab.usd.scene.Mesh`, and ``rest`` (V, 3): the points of the earliest sample, placed."""

    points: Array
    rest: Array
    triangles: IntArray
    normals: Array | None
    uv: Array | None
    albedo: Array | None
    points_close: Array | None
    placements: Array | None = None
    placements_close: Array | None = None

    def areas(self) -> Array:
        """(T,) areas of the triangles at rest, in square metres."""
        return 0.5 * np.linalg.norm(_cross(self.rest[self.triangles]), axis=1)


def bake(local: Triangles, to_world: Array, to_world_close: Array | None) -> Baked:
    """One copy in world space; ``to_world`` (4, 4) in metres as the shutter opens, ``to_world_close`` as it closes."""
    linear, shift = to_world[:3, :3], to_world[:3, 3]
    points, rest = local.points @ linear.T + shift, local.rest @ linear.T + shift
    close = None
    if local.points_close is not None or to_world_close is not None:
        end = to_world if to_world_close is None else to_world_close
        moved = local.points if local.points_close is None else local.points_close
        close = moved @ end[:3, :3].T + end[:3, 3]
        close = None if np.array_equal(close, points) else close
    mirrored = np.linalg.det(linear) < 0
    order = [0, 2, 1] if mirrored else [0, 1, 2]
    triangles = np.ascontiguousarray(local.triangles[:, order], dtype=np.int32)
    uv, albedo = (None if v is None else np.ascontiguousarray(v[:, order]) for v in (local.uv, local.albedo))
    normals = None
    if local.normals is not None:
        normals = _unit(local.normals[:, order] @ np.linalg.inv(linear), points[triangles])
    elif local.groups is not None:
        normals = smooth_normals(points, triangles, local.groups[:, order])
    return Baked(points, rest, triangles, normals, uv, albedo, close)


def bake_many(local: Triangles, to_world: Array, to_world_close: Array | None) -> Baked:
    """Many copies (K, 4, 4), all mirrored or none: the first in world space, the placements relative to it.

    So the first placement is the identity (unless it moves), and the size of the cloth is that of the first copy.
    """
    first = to_world[0]
    baked = bake(local, first, None)
    inverse = np.linalg.inv(first)
    placements = to_world @ inverse
    # Exactly, not up to rounding.
    placements[0] = np.eye(4)
    close = None if to_world_close is None else to_world_close @ inverse
    if close is not None and np.allclose(close, placements, rtol=0.0, atol=1e-12):
        close = None
    return Baked(
        baked.points, baked.rest, baked.triangles, baked.normals, baked.uv, baked.albedo, baked.points_close,
        np.ascontiguousarray(placements[:, :3]), None if close is None else np.ascontiguousarray(close[:, :3]),
    )  # fmt: skip


def smooth_normals(points: Array, triangles: IntArray, groups: NDArray[np.int64]) -> Array:
    """(T, 3, 3) unit normals at the corners: in each group of corners the mean, weighted by the triangles' areas."""
    area = _cross(points[triangles])
    number = int(groups.max()) + 1
    total = np.stack(
        [sum(np.bincount(groups[:, k], area[:, axis], number) for k in range(3)) for axis in range(3)], axis=1
    )
    return _unit(total[groups], points[triangles])


def _unit(normals: Array, corners: Array) -> Array:
    """Normals of length 1; where one is 0, the triangle's own (or z, where that is 0 as well)."""
    flat = _cross(corners)
    flat[np.linalg.norm(flat, axis=1) == 0] = (0.0, 0.0, 1.0)
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.where(lengths > 0, normals, flat[:, None, :])
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _cross(corners: Array) -> Array:
    """(T, 3) normals of triangles (T, 3, 3), twice the area long."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
