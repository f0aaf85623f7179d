"""Primvars of meshes: reading them with their indices resolved, and bringing them to the corners of faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Array
from usdfab.usd.stage import site

UV_NAMES = ("st", "uv", "UVMap", "map1", "st0", "st_0")
"""Primvars that are taken as texture coordinates, in this order; then any of a texture coordinate type."""
ALBEDO = "usdfab:albedo"
"""Primvar that multiplies the fiber albedo of a fabric."""
_UV_TYPES = {Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.TexCoord2dArray, Sdf.ValueTypeNames.TexCoord2hArray}


@dataclass(frozen=True, eq=False)
class Values:
    """``values`` (N, width) of a primvar: one for the mesh (``interpolation`` "constant"), for each face ("uniform"),
    point ("vertex", "varying") or corner of a face ("faceVarying"). ``name`` is without "primvars:"."""

    name: str
    values: Array
    interpolation: str


@dataclass(frozen=True, eq=False)
class Sizes:
    """Numbers of a mesh's points, faces and corners."""

    points: int
    faces: int
    corners: int

    def expected(self, interpolation: str) -> int | None:
        """How many values an interpolation asks for; None for one that USD does not know."""
        known = {"constant": 1, "uniform": self.faces, "vertex": self.points, "varying": self.points}
        return (known | {"faceVarying": self.corners}).get(interpolation)


def at_corners(values: Values, indices: NDArray[np.int64], face: NDArray[np.int64]) -> Array:
    """(C, width) values at the corners; ``indices`` (C,) and ``face`` (C,) are each corner's point and face."""
    if values.interpolation == "faceVarying":
        return values.values
    if values.interpolation == "uniform":
        return values.values[face]
    if values.interpolation == "constant":
        return np.broadcast_to(values.values[0], (len(indices), values.values.shape[1]))
    return values.values[indices]


def read_normals(mesh: UsdGeom.Mesh, time: Usd.TimeCode, sizes: Sizes) -> Values | None:
    """Authored normals in local space; ``primvars:normals`` goes before ``normals``, as in USD. Errors as `checked`."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        name, interpolation, raw = "primvars:normals", primvar.GetInterpolation(), flattened(primvar, time)
    else:
        name, interpolation, raw = "normals", mesh.GetNormalsInterpolation(), mesh.GetNormalsAttr().Get(time)
    return None if raw is None or len(raw) == 0 else checked(mesh.GetPrim(), name, raw, 3, interpolation, sizes)


def read_uv(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, sizes: Sizes, names: tuple[str, ...] = ()
) -> Values | None:  # fmt: skip
    """Texture coordinates, or None: the first of ``names``, then of ``UV_NAMES``, then of a texture coordinate type.

    Primvars of other widths, and those that do not vary over the mesh, are passed over.

    Raises
    ------
    UsdfabError
        If the primvar that is chosen has the wrong number of values, or values that are not finite.
    """
    api = UsdGeom.PrimvarsAPI(mesh)
    candidates = [api.GetPrimvar(name) for name in (*names, *UV_NAMES)]
    candidates += [p for p in api.GetPrimvarsWithValues() if p.GetTypeName() in _UV_TYPES]
    for primvar in candidates:
        if not (primvar and primvar.HasValue()):
            continue
        if primvar.GetInterpolation() not in ("vertex", "varying", "faceVarying"):
            continue
        raw = np.asarray(flattened(primvar, time))
        if raw.ndim == 2 and raw.shape[1] == 2:
            return checked(mesh.GetPrim(), primvar.GetName(), raw, 2, primvar.GetInterpolation(), sizes)
    return None


def read_albedo(mesh: UsdGeom.Mesh, time: Usd.TimeCode, sizes: Sizes) -> Values | None:
    """``primvars:usdfab:albedo``, inherited where it is constant on an ancestor, or None.

    Raises
    ------
    UsdfabError
        For the wrong number of values, values that are not finite or below 0, and other types than colours.
    """
    primvar = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(ALBEDO)
    if not (primvar and primvar.HasValue()):
        return None
    raw = flattened(primvar, time)
    found = checked(mesh.GetPrim(), primvar.GetName(), raw, 3, primvar.GetInterpolation(), sizes)
    if (found.values < 0).any():
        raise UsdfabError("an albedo is below 0", place=_place(mesh.GetPrim(), primvar.GetName()))
    return found


def flattened(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> Any:
    """The primvar's values with its indices resolved; indices out of range are our error, not a silent gap."""
    values = primvar.Get(time)
    if not primvar.IsIndexed() or values is None:
        return values
    indices = np.asarray(primvar.GetIndices(time), dtype=np.int64)
    if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
        attribute = primvar.GetIndicesAttr()
        problem = f"an index is out of range, there are {len(values)} values"
        raise UsdfabError(problem, place=site(attribute.GetStage(), attribute))
    return np.asarray(values)[indices]


def checked(prim: Usd.Prim, name: str, raw: object, width: int, interpolation: str, sizes: Sizes) -> Values:
    """``raw`` as :class:`Values`.

    Raises
    ------
    UsdfabError
        For the wrong width or number of values, an interpolation that USD does not know, and values not finite.
    """
    place = _place(prim, name)
    try:
        values = np.asarray(raw, dtype=np.float64)
        values = values.reshape(1, -1) if values.ndim == 1 and values.size == width else values
    except (TypeError, ValueError) as error:
        raise UsdfabError("the values are not numbers", place=place) from error
    if values.ndim != 2 or values.shape[1] != width:
        raise UsdfabError(f"expected values of {width} numbers each", place=place)
    expected = sizes.expected(interpolation)
    if expected is None:
        raise UsdfabError(f"unknown interpolation {interpolation}", place=place)
    if len(values) != expected:
        raise UsdfabError(f"{len(values)} values for {interpolation} interpolation, expected {expected}", place=place)
    if not np.isfinite(values).all():
        raise UsdfabError("a value is not finite", place=place)
    return Values(name.removeprefix("primvars:"), values, str(interpolation))


def _place(prim: Usd.Prim, name: str) -> str:
    return site(prim.GetStage(), prim.GetPath().AppendProperty(name))
