"""Inside a fabric, in Dr.Jit: patch space, its tile that repeats for ever, and the fibers in it (Li et al. 2024, 6).

The same steps and thresholds as the Numba tracer's slab. A ray that meets the cloth goes into patch space through a
linear map fixed at the hit, whose rows are ``m``: the gradients of the cloth's x and y over the surface and the shading
normal, in patch units (thinnest fiber radius 1) per unit of the macro scene. Directions in patch space are unit
vectors. A place in a tile comes with the tile's whole coordinates, whose hash picks the tile's variant.

Modules of this family import Mitsuba when they are imported: a variant of Dr.Jit must be set before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from usdfab.mi.two_scale_tiles import FiberTiles

EPSILON = 5e-3
"""Shortest ray in patch space, in fiber radii: hits nearer than this are the surface that the ray starts on."""

MAX_TILES = 256
"""Tile borders a ray may cross before it counts as having left; only rays within 1e-3 of the plane get there."""

FAR = 1e30

Lookup = Callable[[Any, Any], Any]


def column(values: npt.ArrayLike, kind: Any) -> Lookup:
    """A table as a function of (index, active); where all rows are the same there is nothing to look up."""
    array = np.atleast_1d(np.asarray(values))
    if np.all(array == array[0]):
        constant = dr.opaque(kind, array[0].item())
        return lambda index, active: constant
    stored = kind(array)
    return lambda index, active: dr.gather(kind, stored, index, active)


@dataclass
class Slab:
    """Where a ray is in a fabric.

    ``place`` in its tile and the tile's coordinates ``ix``, ``iy``; ``m0``, ``m1``, ``m2`` rows of the map from the
    macro scene to patch space; ``up`` patch units per macro unit along the normal; ``fabric`` number of the surface.
    """

    place: Any
    ix: Any
    iy: Any
    m0: Any
    m1: Any
    m2: Any
    up: Any
    fabric: Any

    def to_patch(self, v: Any) -> Any:
        """A macro vector in patch space, not normalised."""
        return mi.Vector3f(dr.dot(self.m0, v), dr.dot(self.m1, v), dr.dot(self.m2, v))

    def covector_to_macro(self, n: Any) -> Any:
        """A normal of patch space in the macro scene, not normalised."""
        return n.x * self.m0 + n.y * self.m1 + n.z * self.m2

    def vector_to_macro(self, v: Any) -> Any:
        """A vector of patch space in the macro scene, up to a positive factor."""
        x, y, z = dr.cross(self.m1, self.m2), dr.cross(self.m2, self.m0), dr.cross(self.m0, self.m1)
        return dr.sign(dr.dot(self.m0, x)) * (v.x * x + v.y * y + v.z * z)


def nowhere() -> Slab:
    """A slab that no ray is in."""
    m0, m1, m2 = (mi.Vector3f(0.0) for _ in range(3))
    return Slab(mi.Point3f(0.0), mi.Int32(0), mi.Int32(0), m0, m1, m2, mi.Float(1.0), mi.UInt32(0))


def mix(x: Any) -> Any:
    """The 64-bit finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    x = (x ^ (x >> 30)) * mi.UInt64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> 27)) * mi.UInt64(0x94D049BB133111EB)
    return x ^ (x >> 31)


class FiberScene:
    """All tiles of a scene as one Mitsuba scene, with the tables that a ray in them needs.

    Parameters
    ----------
    tiles:
        Made by `two_scale_tiles.build_tiles`.
    surfaces:
        For each fabric surface of the scene, the number of its fabric among ``tiles.fabrics``.
    """

    def __init__(self, tiles: FiberTiles, surfaces: Sequence[int], shape: Any) -> None:
        own = [tiles.fabrics[k] for k in surfaces]
        self.scene = mi.load_dict({"type": "scene", "fibers": shape}, parallel=False)
        self.width = column([t.size[0] for t in own], mi.Float)
        self.height = column([t.size[1] for t in own], mi.Float)
        self.low = column([t.low for t in own], mi.Float)
        self.high = column([t.high for t in own], mi.Float)
        self.first = column([t.first for t in own], mi.UInt32)
        self.variants = column([t.variants for t in own], mi.UInt64)
        self.varied = any(t.variants > 1 for t in own)
        self.offset_x = column(tiles.offsets[:, 0], mi.Float)
        self.offset_y = column(tiles.offsets[:, 1], mi.Float)
        self.points = mi.Float(tiles.points.ravel())
        self.segments = mi.UInt32(tiles.segments)
        self.material = column(tiles.material, mi.UInt32)

    def tile_at(self, fabric: Any, ix: Any, iy: Any, active: Any) -> Any:
        """The tile that stands at (ix, iy), by the hash of ``usdfab.fibers.tiles.tile_variants``."""
        first = self.first(fabric, active)
        if not self.varied:
            return first
        key = mi.UInt64(mi.UInt32(ix)) | (mi.UInt64(mi.UInt32(iy)) << 32)
        # Masked lanes look up a 0, by which the processor would divide all the same.
        count = dr.maximum(self.variants(fabric, active), mi.UInt64(1))
        return first + mi.UInt32(mix(mix(key)) % count)

    def offset(self, tile: Any, active: Any) -> Any:
        """Where a tile's lower left corner is among all tiles."""
        return mi.Vector3f(self.offset_x(tile, active), self.offset_y(tile, active), 0.0)

    def thickness(self, slab: Slab, direction: Any, active: Any) -> tuple[Any, Any]:
        """How a ray that leaves a slab goes on: (distance it steps back, thickness of the cloth), macro units.

        It steps back along itself to about the mid-surface: meshes that lie within the cloth's thickness (the body
        under a garment) are then met, and the cloth's own mesh is skipped up to the distance plus twice the thickness.
        """
        low, high = self.low(slab.fabric, active), self.high(slab.fabric, active)
        thickness = (high - low) / slab.up
        steep = dr.maximum(dr.abs(dr.dot(slab.m2, direction)), 1e-9 * slab.up)
        return dr.minimum(dr.maximum(high, -low) / steep, 4.0 * thickness), thickness

    def _step(self, bounds: tuple[Any, ...], p: Any, d: Any) -> tuple[Any, Any, Any]:
        """Distance to the border of the tile or slab, and whether it is one in x, or in y."""
        width, height, low, high = bounds
        # A direction along a border never gets to it: the quotient is infinite, and 0 / 0 where it lies in it.
        far = mi.Float(FAR)
        t = dr.select(d.z != 0.0, (dr.select(d.z > 0.0, high, low) - p.z) / d.z, far)
        tx = dr.select(d.x != 0.0, (dr.select(d.x > 0.0, width, 0.0) - p.x) / d.x, far)
        ty = dr.select(d.y != 0.0, (dr.select(d.y > 0.0, height, 0.0) - p.y) / d.y, far)
        t = dr.maximum(t, 0.0)
        in_x = tx < t
        t = dr.select(in_x, dr.maximum(tx, 0.0), t)
        in_y = ty < t
        t = dr.select(in_y, dr.maximum(ty, 0.0), t)
        return t, in_x & ~in_y, in_y

    def _wrap(self, bounds: tuple[Any, ...], p: Any, d: Any, in_x: Any, in_y: Any) -> tuple[Any, Any, Any]:
        """(place in the next tile, steps of the tile's coordinates) behind a border."""
        width, height, _, _ = bounds
        step_x, step_y = mi.Int32(dr.select(d.x > 0.0, 1, -1)), mi.Int32(dr.select(d.y > 0.0, 1, -1))
        x = dr.select(in_x, dr.select(d.x > 0.0, 0.0, width), p.x)
        y = dr.select(in_y, dr.select(d.y > 0.0, 0.0, height), p.y)
        return mi.Point3f(x, y, p.z), dr.select(in_x, step_x, 0), dr.select(in_y, step_y, 0)

    def _bounds(self, fabric: Any, active: Any) -> tuple[Any, ...]:
        return tuple(c(fabric, active) for c in (self.width, self.height, self.low, self.high))

    def trace(self, slab: Slab, d: Any, active: Any) -> tuple[Any, Any, Slab, Any, Any, Any]:
        """Nearest fiber along a ray.

        Parameters
        ----------
        d:
            Unit direction in patch space.

        Returns
        -------
        (hit, distance to the fiber or to where the slab ends, slab there, tile, segment, place along the segment)
        """
        bounds = self._bounds(slab.fabric, active)
        fabric = slab.fabric

        def body(
            pending: Any, hit: Any, p: Any, ix: Any, iy: Any, tile: Any, total: Any, near: Any, prim: Any, u: Any,
            steps: Any,
        ) -> tuple[Any, ...]:  # fmt: skip
            t, in_x, in_y = self._step(bounds, p, d)
            ray = mi.Ray3f(p + self.offset(tile, pending) + near * d, d)
            ray.maxt = t - near
            found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=pending & (t > near))
            here = pending & (t > near) & found.is_valid()
            hit |= here
            prim, u = dr.select(here, found.prim_index, prim), dr.select(here, found.prim_uv.x, u)
            goes_on = pending & ~here & (in_x | in_y) & (steps < MAX_TILES)
            advance = dr.select(here, near + found.t, t)
            total = dr.select(pending, total + advance, total)
            p = dr.select(pending, dr.fma(advance, d, p), p)
            near = dr.maximum(near - t, 0.0)
            wrapped, dx, dy = self._wrap(bounds, p, d, in_x, in_y)
            p = dr.select(goes_on, wrapped, p)
            ix, iy = dr.select(goes_on, ix + dx, ix), dr.select(goes_on, iy + dy, iy)
            tile = dr.select(goes_on, self.tile_at(fabric, ix, iy, goes_on), tile)
            return goes_on, hit, p, ix, iy, tile, total, near, prim, u, steps + 1

        tile = self.tile_at(fabric, slab.ix, slab.iy, active)
        place = dr.copy((slab.place, slab.ix, slab.iy))  # loops write into what they are given
        _, hit, p, ix, iy, tile, total, _, prim, u, _ = dr.while_loop(
            (
                mi.Bool(active), mi.Bool(False), *place, mi.UInt32(tile), mi.Float(0.0),
                mi.Float(EPSILON), mi.UInt32(0), mi.Float(0.0), mi.UInt32(0),
            ),
            cond=lambda pending, *_: pending,
            body=body,
            labels=("pending", "hit", "p", "ix", "iy", "tile", "total", "near", "prim", "u", "steps"),
            label="tiles",
        )  # fmt: skip
        there = Slab(p, ix, iy, slab.m0, slab.m1, slab.m2, slab.up, slab.fabric)
        return hit, total, there, tile, prim, u

    def occluded(self, slab: Slab, d: Any, tmax: Any, active: Any) -> tuple[Any, Any]:
        """Whether a fiber lies on a ray before it leaves the slab, or before ``tmax``: (occluded, distance passed)."""
        bounds = self._bounds(slab.fabric, active)
        fabric = slab.fabric

        def body(
            pending: Any, blocked: Any, p: Any, ix: Any, iy: Any, tile: Any, total: Any, near: Any, steps: Any
        ) -> tuple[Any, ...]:
            t, in_x, in_y = self._step(bounds, p, d)
            end = dr.minimum(t, tmax - total)
            ray = mi.Ray3f(p + self.offset(tile, pending) + near * d, d)
            ray.maxt = end - near
            asked = pending & (end > near)
            here = asked & self.scene.ray_test(ray, coherent=False, active=asked)
            blocked |= here
            total = dr.select(pending & ~here, total + t, total)
            goes_on = pending & ~here & (in_x | in_y) & (total < tmax) & (steps < MAX_TILES)
            near = dr.maximum(near - t, 0.0)
            wrapped, dx, dy = self._wrap(bounds, dr.fma(t, d, p), d, in_x, in_y)
            p = dr.select(goes_on, wrapped, p)
            ix, iy = dr.select(goes_on, ix + dx, ix), dr.select(goes_on, iy + dy, iy)
            tile = dr.select(goes_on, self.tile_at(fabric, ix, iy, goes_on), tile)
            return goes_on, blocked, p, ix, iy, tile, total, near, steps + 1

        tile = self.tile_at(fabric, slab.ix, slab.iy, active)
        place = dr.copy((slab.place, slab.ix, slab.iy))  # loops write into what they are given
        _, blocked, _, _, _, _, total, _, _ = dr.while_loop(
            (
                mi.Bool(active), mi.Bool(False), *place, mi.UInt32(tile), mi.Float(0.0),
                mi.Float(EPSILON), mi.UInt32(0),
            ),
            cond=lambda pending, *_: pending,
            body=body,
            labels=("pending", "blocked", "p", "ix", "iy", "tile", "total", "near", "steps"),
            label="shadow tiles",
        )  # fmt: skip
        return blocked, total

    def frame(self, slab: Slab, tile: Any, prim: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """(unit tangent, unit normal orthogonal to it) of the fiber at a hit, in the macro scene."""
        start = dr.gather(mi.UInt32, self.segments, prim, active)
        p = [dr.gather(mi.Vector4f, self.points, start + k, active) for k in range(4)]
        v = 1.0 - u
        w = (v * v * v, 4.0 + u * u * (3.0 * u - 6.0), 1.0 + 3.0 * u * (1.0 + u * v), u * u * u)
        dw = (-v * v, u * (3.0 * u - 4.0), 1.0 + u * (2.0 - 3.0 * u), u * u)
        center = sum(k * q for k, q in zip(w, p, strict=True)) / 6.0
        along = sum(k * q for k, q in zip(dw, p, strict=True))
        tangent = dr.normalize(slab.vector_to_macro(dr.normalize(mi.Vector3f(along.x, along.y, along.z))))
        # Tiles' corners are taken off first: places in a tile are small numbers.
        away = slab.place - (mi.Point3f(center.x, center.y, center.z) - self.offset(tile, active))
        normal = slab.covector_to_macro(mi.Vector3f(away))
        normal -= dr.dot(normal, tangent) * tangent
        return tangent, normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-30))
