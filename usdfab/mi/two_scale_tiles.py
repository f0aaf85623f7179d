"""Tiles of fabrics as Mitsuba curves: all tiles of a scene side by side in one shape, each exactly what its cell holds.

A tile is the weave's repeat that stands everywhere on the cloth (`usdfab.fibers.tiles`). It holds every segment of a
fiber that overlaps its cell, those of the neighbouring tiles included, and rays are cut at the cell's border: tiles
that stand beside each other here never see each other. One shape means one ray for every step, whichever fabric and
variant it is in; what a hit needs to know of its segment (its curve's material) stands in an array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers import FiberSystem, OpenCurves, Patch, patch_variants
from usdfab.fibers.tiles import tile_copies

Floats = NDArray[np.float64]

GAP = 4.0
"""Least distance between tiles, in fiber radii."""


class FiberMaterial(NamedTuple):
    """Optics of a fiber, a row of ``FiberTiles.materials``."""

    albedo: tuple[float, float, float]
    gamma_m: float
    gamma_n: float
    gamma_m0: float
    eta: float
    tilt: float


@dataclass(frozen=True, eq=False)
class FabricTiles:
    """Where a fabric's tiles are. Lengths in units of which ``units_per_meter`` make a metre: thinnest radius 1.

    ``first`` of ``FiberTiles.offsets`` and ``variants``, how many; ``size`` of the cell; ``low``, ``high``: the slab.
    """

    first: int
    variants: int
    size: tuple[float, float]
    low: float
    high: float
    units_per_meter: float


@dataclass(frozen=True, eq=False)
class FiberTiles:
    """All tiles of a scene.

    Parameters
    ----------
    points: (N, 4) float32
        Control points and radii of cubic B-splines, all tiles side by side.
    segments: (S,) uint32
        First of the four control points of each segment.
    material: (S,) uint32
        Row of ``materials``.
    offsets: (tiles, 2)
        Where the lower left corner of each tile's cell lies.
    """

    points: NDArray[np.float32]
    segments: NDArray[np.uint32]
    material: NDArray[np.uint32]
    offsets: Floats
    materials: tuple[FiberMaterial, ...]
    fabrics: tuple[FabricTiles, ...]


def build_tiles(fabrics: Sequence[FabricParameters]) -> FiberTiles:
    """The tiles of some fabrics, in their order.

    Raises
    ------
    UsdfabError
        For a fabric whose tile holds no fiber.
    """
    cells: list[tuple[Floats, NDArray[np.int64], NDArray[np.int64]]] = []
    materials: dict[FiberMaterial, int] = {}
    found = []
    for fabric in fabrics:
        patches = patch_variants(fabric, copies=tile_copies(fabric))
        radius = min(s.radius for s in patches[0].systems)
        units = 1.0 / radius
        low, high = patches[0].z_range
        size = units * patches[0].size[0], units * patches[0].size[1]
        found.append(FabricTiles(len(cells), len(patches), size, units * low - 1e-3, units * high + 1e-3, units))
        cells += [_cell(fabric, patch, units, materials) for patch in patches]
        if not all(len(segments) for _, segments, _ in cells):
            raise UsdfabError("the fabric has no fibers", remedy="give its yarns a fiber_count of 1 or more")
    offsets = _side_by_side([points for points, _, _ in cells])
    first = np.cumsum([0] + [len(points) for points, _, _ in cells])
    placed = [points + np.r_[offset, 0.0, 0.0] for (points, _, _), offset in zip(cells, offsets, strict=True)]
    return FiberTiles(
        points=np.concatenate(placed).astype(np.float32),
        segments=np.concatenate([s + k for (_, s, _), k in zip(cells, first, strict=False)]).astype(np.uint32),
        material=np.concatenate([m for _, _, m in cells]).astype(np.uint32),
        offsets=offsets,
        materials=tuple(materials),
        fabrics=tuple(found),
    )


def _cell(
    fabric: FabricParameters, patch: Patch, units: float, materials: dict[FiberMaterial, int]
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """(points (N, 4) with radii, segments (S,), material (S,)) of one tile, its cell's lower left corner at 0.

    ``materials`` grows by what is new.
    """
    points, segments, rows, base = [], [], [], 0
    for system in patch.curves:
        control, start, curve = tile_segments(system, patch.size)
        yarn = fabric.system(system.system)
        points.append(units * np.c_[control, np.full(len(control), system.radius)])
        segments.append(start + base)
        rows.append(_rows(yarn, system.albedo, materials)[curve])
        base += len(control)
    return np.concatenate(points), np.concatenate(segments), np.concatenate(rows)


def _rows(yarn: YarnParameters, albedo: Floats, materials: dict[FiberMaterial, int]) -> NDArray[np.int64]:
    """(curves,) the row of ``materials`` of each curve's colour."""
    colors, which = np.unique(np.clip(albedo, 1e-4, 1.0), axis=0, return_inverse=True)
    optics = (yarn.roughness_longitudinal, yarn.roughness_azimuthal, yarn.roughness_primary, yarn.ior)
    known = [FiberMaterial((float(r), float(g), float(b)), *optics, yarn.cuticle_tilt) for r, g, b in colors]
    return np.array([materials.setdefault(material, len(materials)) for material in known])[which.reshape(-1)]


def tile_segments(
    system: FiberSystem | OpenCurves, size: tuple[float, float]
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """All segments of cubic B-splines that overlap the tile [0, size], copies from the neighbouring tiles included.

    Returns
    -------
    control points (N, 3) metres, first control point (S,) and curve (S,) of each segment
    """
    # One vertex of the curve before and two of the curve after: segments go up to where the next curve's begin.
    control, offsets = system.pinned() if isinstance(system, OpenCurves) else system.extended(1, 2)
    curve = np.repeat(np.arange(system.curves), np.diff(offsets))
    starts = np.flatnonzero(np.arange(len(control)) <= offsets[1:][curve] - 4)
    # A segment lies in the hull of its four control points.
    hull = np.stack([control[starts + k, :2] for k in range(4)])
    low, high = hull.min(axis=0) - system.radius, hull.max(axis=0) + system.radius
    nearest = np.floor(-high.max(axis=0, initial=0.0) / size).astype(int) + 1
    farthest = np.ceil(1.0 - low.min(axis=0, initial=0.0) / size).astype(int) - 1
    points, segments, owners, base = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], 0
    for i in range(nearest[0], farthest[0] + 1):
        for j in range(nearest[1], farthest[1] + 1):
            shift = np.array([i * size[0], j * size[1], 0.0])
            inside = np.all((high + shift[:2] > 0.0) & (low + shift[:2] < np.asarray(size)), axis=1)
            chosen = starts[inside]
            used = np.zeros(len(control), dtype=bool)
            for k in range(4):
                used[chosen + k] = True
            points.append(control[used] + shift)
            segments.append((np.cumsum(used) - 1)[chosen] + base)
            owners.append(curve[chosen])
            base += int(used.sum())
    return np.concatenate(points), np.concatenate(segments), np.concatenate(owners)


def _side_by_side(cells: Sequence[Floats]) -> Floats:
    """(tiles, 2) shifts that put tiles onto a square grid about the origin, none overlapping another."""
    if not cells:
        return np.zeros((0, 2))
    low = np.array([(p[:, :2] - p[:, 3:]).min(axis=0) for p in cells])
    high = np.array([(p[:, :2] + p[:, 3:]).max(axis=0) for p in cells])
    stride = (high - low).max(axis=0) + GAP
    columns = int(np.ceil(np.sqrt(len(cells))))
    number = np.arange(len(cells))
    place = np.stack([number % columns, number // columns], axis=1) * stride
    extent = place.max(axis=0) + stride
    return place - low - 0.5 * extent
