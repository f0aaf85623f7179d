"""How a fabric lies on a surface: primvars that turn and scale it, read into the texture coordinates themselves.

Materials are shared, so what differs from mesh to mesh stands on the prims that wear them: ``primvars:usdfab:rotation``
(degrees) and ``primvars:usdfab:scale``, constant, inherited by what is below, also by the faces of a GeomSubset.
Renderers need not know: the scene's ``uv`` come turned, its ``meters_per_uv`` scaled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Array, Texture
from usdfab.usd.stage import site

ROTATION = "usdfab:rotation"
"""Primvar: degrees by which the fabric is turned on its surface, from u towards v."""
SCALE = "usdfab:scale"
"""Primvar: how many times larger than life the fabric lies on its surface."""


@dataclass(frozen=True)
class Orientation:
    """``rotation``: degrees by which weft and warp are turned from u towards v, so that at 90 the weft runs along v and
    the warp along -u. ``scale``: factor by which yarns and weave grow on the surface."""

    rotation: float = 0.0
    scale: float = 1.0

    @property
    def matrix(self) -> Array:
        """(2, 2): mesh uv to the turned uv, in which the weft runs along the first axis."""
        quarter, rest = divmod(self.rotation, 90.0)
        # Exact for right angles, so that a cloth turned by 90 degrees has its axes swapped without rounding.
        c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
        if rest:
            c, s = math.cos(math.radians(self.rotation)), math.sin(math.radians(self.rotation))
        return np.array([[c, s], [-s, c]])

    def turned(self, uv: Array) -> Array:
        """(..., 2) texture coordinates in which the weft runs along the first axis, the warp along the second."""
        return uv @ self.matrix.T if self.rotation % 360.0 else uv

    def in_place(self, texture: Texture | None) -> Texture | None:
        """``texture`` such that the turned coordinates find it where it lies in the mesh's own."""
        if texture is None or not self.rotation % 360.0:
            return texture
        transform = texture.uv_transform.copy()
        transform[:, :2] = transform[:, :2] @ self.matrix.T
        return replace(texture, uv_transform=transform)


def read_orientation(prim: Usd.Prim, time: Usd.TimeCode) -> Orientation:
    """The orientation that a mesh or a subset of its faces has or inherits.

    Raises
    ------
    UsdfabError
        For values that are not single finite numbers, and a scale that is not above 0.
    """
    return Orientation(_number(prim, ROTATION, 0.0, time), _number(prim, SCALE, 1.0, time))


def _number(prim: Usd.Prim, name: str, default: float, time: Usd.TimeCode) -> float:
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    raw = primvar.Get(time) if primvar and primvar.HasValue() else None
    if raw is None:
        return default
    place = site(prim.GetStage(), primvar.GetAttr())
    try:
        numbers = np.asarray(raw, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise UsdfabError(f"expected a number, got {raw!r}", place=place) from error
    if len(numbers) != 1 or not np.isfinite(numbers).all():
        raise UsdfabError("expected one finite number", place=place, remedy="author it as a constant primvar")
    if name == SCALE and not numbers[0] > 0:
        raise UsdfabError(f"a scale of {numbers[0]:g} is not above 0", place=place)
    return float(numbers[0])
