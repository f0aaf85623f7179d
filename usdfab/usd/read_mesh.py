"""UsdGeom meshes as triangles in metres and world space, with their materials still as prims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Array, IntArray
from usdfab.usd.stage import site
from usdfab.usd.triangulate import triangulate

UV_NAMES = ("st", "uv", "UVMap", "map1", "st0", "st_0")
"""Primvars that are taken as texture coordinates, in this order; then any of a texture coordinate type."""
_UV_TYPES = {Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.TexCoord2dArray, Sdf.ValueTypeNames.TexCoord2hArray}


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A mesh before its materials are resolved.

    ``points`` (V, 3) metres; ``triangles`` (T, 3); ``normals`` (T, 3, 3) or None; ``uv`` (T, 3, 2) or None;
    ``materials``: the Material prims bound to the mesh and its subsets, None where nothing is bound; ``slot`` (T,):
    index into ``materials``.
    """

    prim: Usd.Prim
    points: Array
    triangles: IntArray
    normals: Array | None
    uv: Array | None
    materials: list[Usd.Prim | None]
    slot: NDArray[np.int64]
    double_sided: bool

    def areas(self) -> Array:
        """(T,) areas of the triangles in square metres."""
        p = self.points[self.triangles]
        return 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)


def read_mesh(
    prim: Usd.Prim, to_world: Array, meters_per_unit: float, time: Usd.TimeCode
) -> tuple[RawMesh | None, list[str]]:
    """The mesh of ``prim``, or None where it has no faces (a warning then says so), and warnings.

    Parameters
    ----------
    to_world: (4, 4)
        Local to world in the stage's units, column vectors.

    Raises
    ------
    UsdfabError
        For points that are not finite, indices out of range, and primvars of the wrong length.
    """
    mesh, place = UsdGeom.Mesh(prim), str(prim.GetPath())
    points, counts, indices = _topology(mesh, time)
    if len(counts) == 0 or len(points) == 0:
        return None, [f"{place}: the mesh has no faces, left out"]
    linear = to_world[:3, :3]
    determinant = float(np.linalg.det(linear))
    if not np.isfinite(to_world).all() or determinant == 0.0:
        return None, [f"{place}: the transform is singular, the mesh is left out"]
    warnings = []
    if (counts < 3).any():
        warnings.append(f"{place}: {int((counts < 3).sum())} faces of fewer than three corners are left out")
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(time) or [], dtype=np.int64)
    corners, faces = triangulate(counts, indices, points)
    if len(holes):
        keep = ~np.isin(faces, holes)
        corners, faces = corners[keep], faces[keep]
    if len(corners) == 0:
        return None, [*warnings, f"{place}: the mesh has no triangles, left out"]
    # A left-handed mesh winds clockwise; a mirroring transform turns the winding once more.
    left_handed = mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded
    if left_handed != (determinant < 0):
        corners = corners[:, [0, 2, 1]]
    triangles = indices[corners].astype(np.int32)
    world = (points @ linear.T + to_world[:3, 3]) * meters_per_unit
    normals = _normals(mesh, time, counts, corners, faces, triangles)
    if normals is not None:
        normals = _unit(normals @ np.linalg.inv(linear), world[triangles])
    elif mesh.GetSubdivisionSchemeAttr().Get(time) != UsdGeom.Tokens.none:
        normals = smooth_normals(world, triangles)
    uv = _uv(mesh, time, len(points), corners, triangles)
    materials, face_slot = _materials(prim, len(counts), time)
    double_sided = bool(mesh.GetDoubleSidedAttr().Get(time))
    return RawMesh(prim, world, triangles, normals, uv, materials, face_slot[faces], double_sided), warnings


def _topology(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
    stage = mesh.GetPrim().GetStage()
    raw = mesh.GetPointsAttr().Get(time)
    points = np.asarray(raw if raw is not None else [], dtype=np.float64).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time) or [], dtype=np.int64)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time) or [], dtype=np.int64)
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise UsdfabError(f"point {bad} is not finite", place=site(stage, mesh.GetPointsAttr()))
    if (counts < 0).any() or counts.sum() != len(indices):
        raise UsdfabError(
            f"the face sizes ask for {int(counts.sum())} indices, there are {len(indices)}",
            place=site(stage, mesh.GetFaceVertexCountsAttr()),
        )
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        worst = int(indices.max() if indices.max() >= len(points) else indices.min())
        raise UsdfabError(
            f"index {worst} is out of range, there are {len(points)} points",
            place=site(stage, mesh.GetFaceVertexIndicesAttr()),
        )
    return points, counts, indices


# --- primvars --------------------------------------------------------------------------------------------------------


def _at_corners(
    prim: Usd.Prim,
    name: str,
    values: Array,
    interpolation: str,
    sizes: dict[str, int],
    corners: NDArray[np.int64],
    faces: NDArray[np.int64] | None,
    triangles: IntArray,
) -> Array | None:
    """(T, 3, width) values at the triangles' corners; None for an interpolation that has none."""
    expected = sizes.get(interpolation)
    if expected is None:
        return None
    place = site(prim.GetStage(), prim.GetPath().AppendProperty(name))
    if len(values) != expected:
        raise UsdfabError(f"{len(values)} values for {interpolation} interpolation, expected {expected}", place=place)
    if not np.isfinite(values).all():
        raise UsdfabError("a value is not finite", place=place)
    if interpolation == UsdGeom.Tokens.faceVarying:
        return values[corners]
    if interpolation == UsdGeom.Tokens.uniform:
        assert faces is not None
        return np.repeat(values[faces][:, None], 3, axis=1)
    return values[triangles]


def _normals(
    mesh: UsdGeom.Mesh,
    time: Usd.TimeCode,
    counts: NDArray[np.int64],
    corners: NDArray[np.int64],
    faces: NDArray[np.int64],
    triangles: IntArray,
) -> Array | None:
    """(T, 3, 3) authored normals in local space; ``primvars:normals`` goes before ``normals``, as in USD."""
    prim, tokens = mesh.GetPrim(), UsdGeom.Tokens
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        name, interpolation, raw = "primvars:normals", primvar.GetInterpolation(), _flattened(primvar, time)
    else:
        name, interpolation, raw = "normals", mesh.GetNormalsInterpolation(), mesh.GetNormalsAttr().Get(time)
    if raw is None or len(raw) == 0:
        return None
    points = len(mesh.GetPointsAttr().Get(time))
    sizes = {
        tokens.vertex: points,
        tokens.varying: points,
        tokens.uniform: len(counts),
        tokens.faceVarying: int(counts.sum()),
    }
    values = np.asarray(raw, dtype=np.float64).reshape(-1, 3)
    return _at_corners(prim, name, values, interpolation, sizes, corners, faces, triangles)


def _uv(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, points: int, corners: NDArray[np.int64], triangles: IntArray
) -> Array | None:
    """(T, 3, 2) texture coordinates, or None."""
    prim, tokens = mesh.GetPrim(), UsdGeom.Tokens
    api = UsdGeom.PrimvarsAPI(prim)
    candidates = [api.GetPrimvar(name) for name in UV_NAMES]
    candidates += [p for p in api.GetPrimvarsWithValues() if p.GetTypeName() in _UV_TYPES]
    sizes = {
        tokens.vertex: points,
        tokens.varying: points,
        tokens.faceVarying: len(mesh.GetFaceVertexIndicesAttr().Get(time)),
    }
    for primvar in candidates:
        if not (primvar and primvar.HasValue()) or primvar.GetInterpolation() not in sizes:
            continue
        raw = np.asarray(_flattened(primvar, time), dtype=np.float64)
        if raw.ndim == 2 and raw.shape[1] == 2:
            name = primvar.GetName()
            return _at_corners(prim, name, raw, primvar.GetInterpolation(), sizes, corners, None, triangles)
    return None


def _flattened(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> Any:
    """The primvar's values with its indices resolved; indices out of range are our error, not a silent gap."""
    if primvar.IsIndexed():
        values, indices = primvar.Get(time), np.asarray(primvar.GetIndices(time), dtype=np.int64)
        if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
            attribute = primvar.GetIndicesAttr()
            place = site(attribute.GetStage(), attribute)
            raise UsdfabError(f"an index is out of range, there are {len(values)} values", place=place)
        return np.asarray(values)[indices]
    return primvar.Get(time)


def smooth_normals(points: Array, triangles: IntArray) -> Array:
    """(T, 3, 3) unit normals at the corners: the mean of the normals around each point, weighted by area."""
    p = points[triangles]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, triangles[:, corner], area)
    return _unit(total[triangles], p)


def _unit(normals: Array, corners: Array) -> Array:
    """Normals of length 1; where one is 0, the triangle's own (or z, where that is 0 as well)."""
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat[np.linalg.norm(flat, axis=1) == 0] = (0.0, 0.0, 1.0)
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.where(lengths > 0, normals, flat[:, None, :])
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


# --- material bindings -----------------------------------------------------------------------------------------------


def _materials(prim: Usd.Prim, faces: int, time: Usd.TimeCode) -> tuple[list[Usd.Prim | None], NDArray[np.int64]]:
    """Bound materials and, for each face, which of them it has."""
    materials: list[Usd.Prim | None] = [_bound(prim)]
    slot = np.zeros(faces, dtype=np.int64)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        if subset.GetElementTypeAttr().Get() != UsdGeom.Tokens.face:
            continue
        indices = np.asarray(subset.GetIndicesAttr().Get(time) or [], dtype=np.int64)
        if len(indices) and (indices.min() < 0 or indices.max() >= faces):
            place = site(prim.GetStage(), subset.GetIndicesAttr())
            raise UsdfabError(f"a face index is out of range, the mesh has {faces} faces", place=place)
        slot[indices] = len(materials)
        materials.append(_bound(subset.GetPrim()))
    return materials, slot


def _bound(prim: Usd.Prim) -> Usd.Prim | None:
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return material.GetPrim() if material else None
