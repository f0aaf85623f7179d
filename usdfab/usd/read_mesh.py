"""UsdGeom meshes as cages: polygons, primvars and material bindings as authored, in metres and in local space."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.frames import Shutter
from usdfab.usd.primvars import Sizes, Values, read_albedo, read_normals, read_uv
from usdfab.usd.problems import Problems
from usdfab.usd.scene import Array
from usdfab.usd.stage import site
from usdfab.usd.subdivide import Topology, topology

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Bindings:
    """Material prims bound to a mesh and its subsets, None where nothing is, and (F,) which of them the faces have.

    ``prims``: the mesh and the subsets that they are bound to."""

    materials: list[Usd.Prim | None]
    slot: Ints
    prims: list[Usd.Prim]


@dataclass(frozen=True, eq=False)
class Cage:
    """A mesh as authored: polygons in local space, metres.

    ``points`` (V, 3); ``points_close`` at the shutter's closing, or None; ``rest`` (V, 3) the earliest sample, in which
    the mesh is unwrapped if need be. ``number`` (F,) are the authored numbers of the faces, ``hole`` (F,) says which
    are not drawn. ``scheme`` is the subdivision scheme, ``topology`` has its creases, ``boundary`` is
    ``interpolateBoundary``, ``seams`` ``faceVaryingLinearInterpolation``.
    """

    prim: Usd.Prim
    points: Array
    points_close: Array | None
    rest: Array
    topology: Topology
    number: Ints
    hole: NDArray[np.bool_]
    scheme: str
    boundary: str
    seams: str
    left_handed: bool
    double_sided: bool
    normals: Values | None
    uv: Values | None
    albedo: Values | None


def read_cage(
    prim: Usd.Prim,
    meters_per_unit: float,
    shutter: Shutter,
    problems: Problems,
    uv_names: tuple[str, ...] = (),
) -> Cage | None:
    """The mesh of ``prim``; None where it has no faces (a warning then says so).

    Primvars that are wrong are faults, and left out. Points that move are at the shutter's opening and closing (from
    ``velocities``, where the mesh has them); if the number of points or the faces change while it is open, the mesh is
    still, and a warning says so.

    Parameters
    ----------
    uv_names:
        Primvars to take as texture coordinates before the usual ones (``usdfab.usd.primvars``).

    Raises
    ------
    UsdfabError
        For points that are not finite, and counts and indices that do not fit.
    """
    mesh, place, time = UsdGeom.Mesh(prim), str(prim.GetPath()), shutter.frame
    points, counts, indices = _polygons(mesh, time)
    if len(counts) == 0 or len(points) == 0:
        problems.warn(f"{place}: the mesh has no faces, left out")
        return None
    sizes = Sizes(len(points), len(counts), len(indices))
    found: dict[str, Values | None] = {"normals": None, "uv": None, "albedo": None}
    for name, instead in (("normals", "no normals"), ("uv", "no texture coordinates"), ("albedo", "no albedo")):
        with problems.tolerating(place, f"the mesh is taken to have {instead}"):
            if name == "normals":
                found[name] = read_normals(mesh, time, sizes)
            elif name == "uv":
                found[name] = read_uv(mesh, time, sizes, uv_names)
            else:
                found[name] = read_albedo(mesh, time, sizes)
    opened, closed = _moving_points(mesh, points, shutter, problems)
    holes = _indices(mesh.GetHoleIndicesAttr(), time)
    number = np.flatnonzero(counts >= 3)
    if len(number) < len(counts):
        problems.warn(f"{place}: {len(counts) - len(number)} faces of fewer than three corners are left out")
        keep_face = counts >= 3
        keep_corner = np.repeat(keep_face, counts)
        counts, indices = counts[keep_face], indices[keep_corner]
        found = {name: _kept(values, keep_face, keep_corner) for name, values in found.items()}
    boundary = str(mesh.GetInterpolateBoundaryAttr().Get(time))
    return Cage(
        prim, opened * meters_per_unit, None if closed is None else closed * meters_per_unit,
        _rest(mesh, opened) * meters_per_unit,
        _topology(mesh, counts, indices, len(points), boundary, time, problems), number, np.isin(number, holes),
        str(mesh.GetSubdivisionSchemeAttr().Get(time)), boundary,
        str(mesh.GetFaceVaryingLinearInterpolationAttr().Get(time)),
        mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded, bool(mesh.GetDoubleSidedAttr().Get(time)),
        **found,
    )  # fmt: skip


# --- polygons --------------------------------------------------------------------------------------------------------


def _polygons(mesh: UsdGeom.Mesh, time: Usd.TimeCode) -> tuple[Array, Ints, Ints]:
    stage = mesh.GetPrim().GetStage()
    points = _points(mesh, mesh.GetPointsAttr().Get(time))
    counts = _indices(mesh.GetFaceVertexCountsAttr(), time)
    indices = _indices(mesh.GetFaceVertexIndicesAttr(), time)
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


def _points(mesh: UsdGeom.Mesh, raw: object) -> Array:
    points = np.asarray(raw if raw is not None else [], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise UsdfabError(f"point {bad} is not finite", place=site(mesh.GetPrim().GetStage(), mesh.GetPointsAttr()))
    return points


def _indices(attribute: Usd.Attribute, time: Usd.TimeCode) -> Ints:
    raw = attribute.Get(time)
    return np.asarray(raw if raw is not None else [], dtype=np.int64)


def _moving_points(
    mesh: UsdGeom.Mesh, points: Array, shutter: Shutter, problems: Problems
) -> tuple[Array, Array | None]:
    """Points as the shutter opens, and as it closes where they differ."""
    if shutter.close is None:
        return points, None
    attributes = (mesh.GetPointsAttr(), mesh.GetVelocitiesAttr(), mesh.GetFaceVertexCountsAttr())
    if not any(a.ValueMightBeTimeVarying() or a.GetNumTimeSamples() for a in attributes):
        return points, None
    opened, closed = (_points(mesh, mesh.ComputePointsAtTime(t, shutter.frame)) for t in (shutter.open, shutter.close))
    faces = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    velocities = mesh.GetVelocitiesAttr().Get(shutter.frame)
    carried = velocities is not None and len(velocities) == len(points)
    same = carried or all(
        np.array_equal(_indices(a, shutter.frame), _indices(a, t)) for a in faces for t in (shutter.open, shutter.close)
    )
    if not (same and len(opened) == len(closed) == len(points)):
        problems.warn(f"{mesh.GetPath()}: points or faces change while the shutter is open, the mesh is not blurred")
        return points, None
    return opened, None if np.array_equal(opened, closed) else closed


def _rest(mesh: UsdGeom.Mesh, points: Array) -> Array:
    raw = mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
    rest = np.asarray(raw if raw is not None else [], dtype=np.float64).reshape(-1, 3)
    return rest if rest.shape == points.shape and np.isfinite(rest).all() else points


def _topology(
    mesh: UsdGeom.Mesh, counts: Ints, indices: Ints, points: int, boundary: str, time: Usd.TimeCode, problems: Problems
) -> Topology:
    """The faces with their creases and corners; creases that do not fit are faults, and left out."""
    pairs, sharp = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    corners, corner_sharp = np.zeros(0, dtype=np.int64), np.zeros(0)
    with problems.tolerating(str(mesh.GetPath()), "its creases and corners are left out"):
        pairs, sharp = _creases(mesh, points, time)
        corners = _indices(mesh.GetCornerIndicesAttr(), time)
        raw = mesh.GetCornerSharpnessesAttr().Get(time)
        corner_sharp = np.asarray(raw if raw is not None else [], dtype=np.float64)
        if len(corners) != len(corner_sharp) or ((corners < 0) | (corners >= points)).any():
            corners, corner_sharp = corners[:0], corner_sharp[:0]
            place = site(mesh.GetPrim().GetStage(), mesh.GetCornerIndicesAttr())
            raise UsdfabError("corner indices and sharpnesses do not fit", place=place)
    return topology(
        counts, indices, points, pairs, sharp, corners, corner_sharp, sharp_boundary_corners=boundary != "edgeOnly"
    )


def _creases(mesh: UsdGeom.Mesh, points: int, time: Usd.TimeCode) -> tuple[Ints, Array]:
    """(n, 2) points of each creased edge, (n,) sharpness."""
    indices = _indices(mesh.GetCreaseIndicesAttr(), time)
    lengths = _indices(mesh.GetCreaseLengthsAttr(), time)
    raw = mesh.GetCreaseSharpnessesAttr().Get(time)
    sharp = np.asarray(raw if raw is not None else [], dtype=np.float64)
    if len(indices) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    edges = int((lengths - 1).sum())
    fits = (lengths >= 2).all() and lengths.sum() == len(indices) and len(sharp) in (len(lengths), edges)
    if not fits or ((indices < 0) | (indices >= points)).any() or not np.isfinite(sharp).all():
        place = site(mesh.GetPrim().GetStage(), mesh.GetCreaseIndicesAttr())
        raise UsdfabError("crease indices, lengths and sharpnesses do not fit", place=place)
    last = np.cumsum(lengths) - 1
    first = np.setdiff1d(np.arange(len(indices)), last)
    return np.stack([indices[first], indices[first + 1]], axis=1), (
        np.repeat(sharp, lengths - 1) if len(sharp) == len(lengths) else sharp
    )


def _kept(values: Values | None, keep_face: NDArray[np.bool_], keep_corner: NDArray[np.bool_]) -> Values | None:
    """The values of the faces that are kept."""
    keep = {"uniform": keep_face, "faceVarying": keep_corner}.get(values.interpolation) if values else None
    return values if values is None or keep is None else replace(values, values=values.values[keep])


# --- material bindings -----------------------------------------------------------------------------------------------


def read_bindings(prim: Usd.Prim, time: Usd.TimeCode, problems: Problems) -> Bindings:
    """Materials bound to a mesh and to subsets of its faces. A subset with indices out of range is a fault."""
    counts = UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get(time)
    faces = 0 if counts is None else len(counts)
    materials: list[Usd.Prim | None] = [_bound(prim)]
    slot, prims = np.zeros(faces, dtype=np.int64), [prim]
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        if subset.GetElementTypeAttr().Get() != UsdGeom.Tokens.face:
            continue
        with problems.tolerating(str(subset.GetPath()), "the subset is left out"):
            indices = _indices(subset.GetIndicesAttr(), time)
            if len(indices) and (indices.min() < 0 or indices.max() >= faces):
                place = site(prim.GetStage(), subset.GetIndicesAttr())
                raise UsdfabError(f"a face index is out of range, the mesh has {faces} faces", place=place)
            slot[indices] = len(materials)
            materials.append(_bound(subset.GetPrim()))
            prims.append(subset.GetPrim())
    return Bindings(materials, slot, prims)


def _bound(prim: Usd.Prim) -> Usd.Prim | None:
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return material.GetPrim() if material else None
