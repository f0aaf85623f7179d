"""From the macro scene into a fabric, in Dr.Jit: what is known of a triangle of cloth, and the map into patch space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from usdfab.mi.two_scale_cloth import ClothTriangles
from usdfab.mi.two_scale_slab import FiberScene, Slab, column
from usdfab.mi.two_scale_tiles import FabricTiles

_COLUMNS = 12
"""Floats at a corner: shading normal, gradients of the cloth's x and y, place on the cloth (2), one spare."""


class ClothTables:
    """Arrays of all triangles of cloth on the device.

    Parameters
    ----------
    scale:
        Macro units per metre.
    tiles, meters_per_uv:
        For each fabric surface of the scene.
    maps:
        For each fabric surface its albedo map as a function of texture coordinates, or None.
    """

    def __init__(
        self,
        cloth: ClothTriangles,
        scale: float,
        tiles: Sequence[FabricTiles],
        meters_per_uv: Sequence[float],
        maps: Sequence[Callable[[Any], Any] | None],
    ) -> None:
        units = np.array([t.units_per_meter for t in tiles])[cloth.fabric]
        size = np.array([t.size for t in tiles])[cloth.fabric]
        place = cloth.uv * (np.asarray(meters_per_uv)[cloth.fabric] * units)[:, None, None]
        # Places are counted from a tile near the triangle: far from uv's origin they keep their digits.
        base = np.floor(place.min(axis=1) / size)
        place -= (base * size)[:, None]
        frames = cloth.frames.copy()
        frames[..., 3:] *= (units / scale)[:, None, None]
        corners = np.concatenate([frames, place, np.zeros_like(place[..., :1])], axis=2)
        self.corners = mi.Float(corners.astype(np.float32).ravel())
        self.normal = mi.Float(cloth.normal.astype(np.float32).ravel())
        wrapped = (base.astype(np.int64) & 0xFFFFFFFF).astype(np.uint32)
        self.base_x, self.base_y = (column(wrapped[:, k].view(np.int32), mi.Int32) for k in (0, 1))
        self.fabric = column(cloth.fabric, mi.UInt32)
        self.mesh = column(cloth.mesh, mi.UInt32)
        self.maps = [(k, one) for k, one in enumerate(maps) if one is not None]
        self.tinted = cloth.tinted or bool(self.maps)
        self.tints = mi.Float(cloth.tint.astype(np.float32).ravel()) if cloth.tinted else None
        self.uv = mi.Float(cloth.uv.astype(np.float32).ravel()) if self.maps else None

    def enter(
        self, fibers: FiberScene, prim: Any, uv: Any, direction: Any, t: Any, active: Any
    ) -> tuple[Any, Slab, Any]:
        """The map into patch space at a hit, and where the ray enters the slab.

        Parameters
        ----------
        prim, uv, t:
            Triangle, its second and third barycentric coordinate, and distance of the hit.

        Returns
        -------
        (ok, slab, distance stepped back); not ok where the surface has no usable frame: exactly edge-on.
        """
        weights = (1.0 - uv.x - uv.y, uv.x, uv.y)
        parts = [mi.Vector4f(0.0)] * 3
        for corner, weight in enumerate(weights):
            row = 3 * (3 * prim + corner)
            parts = [
                part + weight * dr.gather(mi.Vector4f, self.corners, row + k, active) for k, part in enumerate(parts)
            ]
        a, b, c = parts
        smooth, gx, gy = mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(a.w, b.x, b.y), mi.Vector3f(b.z, b.w, c.x)
        normal = dr.gather(mi.Vector3f, self.normal, prim, active)
        fabric = self.fabric(prim, active)
        low, high = fibers.low(fabric, active), fibers.high(fabric, active)
        width, height = fibers.width(fabric, active), fibers.height(fabric, active)

        # The interpolated normal must see the ray from the same side as the triangle does, not at a grazing angle, and
        # must not lie in the triangle.
        faces = dr.dot(direction, normal)
        length = dr.norm(smooth)
        smooth = smooth / dr.maximum(length, 1e-30)
        across = dr.dot(direction, smooth)
        usable = (
            (length > 0.0) & (across * faces > 0.0) & (dr.abs(across) >= 0.02) & (dr.abs(dr.dot(smooth, normal)) >= 0.1)
        )
        n, across = dr.select(usable, smooth, normal), dr.select(usable, across, faces)
        # Gradients in the plane normal to it.
        gx, gy = gx - dr.dot(gx, n) * n, gy - dr.dot(gy, n) * n
        area = dr.abs(dr.dot(dr.cross(gx, gy), n))
        size = dr.maximum(dr.squared_norm(gx), dr.squared_norm(gy))
        ok = active & (area > 1e-6 * size) & (size > 0.0) & (dr.abs(across) > 1e-5)
        up = dr.sqrt(area)
        slab = Slab(mi.Point3f(0.0), mi.Int32(0), mi.Int32(0), gx, gy, up * n, up, mi.UInt32(fabric))
        p = slab.to_patch(direction)
        # Step back from the mid-surface to the side of the slab that the ray comes from.
        border = dr.select(p.z < 0.0, high, -low)
        back = dr.minimum(border / dr.maximum(dr.abs(p.z), 1e-9 * up), dr.minimum(t, 20.0 * (high - low) / up))
        x, y = c.y - back * p.x, c.z - back * p.y
        ix, iy = dr.floor(x / width), dr.floor(y / height)
        slab.place = mi.Point3f(x - ix * width, y - iy * height, -back * p.z)
        slab.ix, slab.iy = self.base_x(prim, active) + mi.Int32(ix), self.base_y(prim, active) + mi.Int32(iy)
        return ok, slab, back

    def tint(self, prim: Any, uv: Any, active: Any) -> Any:
        """Factor of the fiber albedo from the mesh's colours and the fabric's albedo map."""
        weights = (1.0 - uv.x - uv.y, uv.x, uv.y)
        factor = mi.Color3f(1.0)
        if self.tints is not None:
            corners = [dr.gather(mi.Color3f, self.tints, 3 * prim + k, active) for k in range(3)]
            factor = mi.Color3f(sum(w * c for w, c in zip(weights, corners, strict=True)))
        if self.uv is not None:
            corners = [dr.gather(mi.Point2f, self.uv, 3 * prim + k, active) for k in range(3)]
            place = mi.Point2f(sum(w * c for w, c in zip(weights, corners, strict=True)))
            fabric = self.fabric(prim, active)
            for number, texture in self.maps:
                factor = dr.select(fabric == number, factor * texture(place), factor)
        return factor
