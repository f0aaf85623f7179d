"""Light deep in a cloth, looked up instead of traced: a radiance cache for pictures that may be a little wrong.

In bright cloth a path meets a dozen fibers, and what it finds after the first few hardly depends on where exactly that
was. So a few whole paths are taken first, and the light that comes back to their n-th vertex is averaged over small
boxes of a crossing; the paths of the picture end there and take the box's mean. Boxes are kept apart for the crossings
of the weave that differ, for each kind of fiber, and for light that goes up or down.

With the throughput beta of a path at that vertex and the light L that it brings home from there on, a box holds
sum(L) / sum(beta), the mean of the radiance weighted as it will be looked up. So the mean brightness stays right.
Averages of few paths are noise: boxes that saw little lean on what lies around them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, FabricParameters, Weave
from usdfab.tracer.intrinsics import KERNEL, borrow
from usdfab.tracer.patch_scene import PatchScene

Floats = NDArray[np.float64]

BOXES = 4
"""Along each side of a crossing."""
LAYERS = 6
"""Of boxes, from the lowest to the highest place of any fiber."""
LEAN = 16.0
"""Paths that must have met a box before it counts as much as what lies around it."""

LIGHT, THROUGHPUT = slice(0, 3), slice(3, 6)
"""Columns of ``RadianceCache.sums``."""


class RadianceCache(NamedTuple):
    """Boxes as kernels read and fill them. Lengths in patch units.

    Parameters
    ----------
    depth: int
        Vertex (1: what the camera sees) at which light is looked up, or learned.
    cell: (2,)
        Sides of a crossing.
    low, high: float
        Lowest and highest place of boxes.
    shape: (6,)
        Kinds of fibers (rows of ``Patches.materials`` of a tile), directions (down, up), layers, crossings that differ,
        and boxes along y and x of a crossing; V in all.
    crossings: (picks, ends) int64
        Of the weave's repeat: which of those that differ.
    radiance: (V, 3)
        What is looked up.
    sums: (V, 6)
        Light and throughput that paths brought, while learning; else of length 0.
    """

    depth: int
    cell: tuple[float, float]
    low: float
    high: float
    shape: tuple[int, int, int, int, int, int]
    crossings: NDArray[np.int64]
    radiance: Floats
    sums: Floats


@njit(**KERNEL)
def borrowed_cache(cache):
    """The cache with arrays that are not reference-counted (see ``intrinsics.borrow``); None for None."""
    if cache is None:
        return None
    return RadianceCache(
        cache.depth, cache.cell, cache.low, cache.high, cache.shape, borrow(cache.crossings), borrow(cache.radiance),
        borrow(cache.sums),
    )  # fmt: skip


@njit(**KERNEL)
def box_at(cache, row, up, x, y, z):
    """The box of a place in a tile, for a fiber's material and a ray that goes up or not."""
    kinds, _, layers, crossings, rows, columns = cache.shape
    u, v = x / cache.cell[0], y / cache.cell[1]
    end, pick = math.floor(u), math.floor(v)
    i = min(np.int64((u - end) * columns), columns - 1)
    j = min(np.int64((v - pick) * rows), rows - 1)
    k = min(max(np.int64((z - cache.low) / (cache.high - cache.low) * layers), 0), layers - 1)
    picks, ends = cache.crossings.shape
    crossing = cache.crossings[np.int64(pick) % picks, np.int64(end) % ends]
    return ((((row % kinds * 2 + (1 if up else 0)) * layers + k) * crossings + crossing) * rows + j) * columns + i


def crossings_that_differ(weave: Weave) -> NDArray[np.int64]:
    """(picks, ends) numbers from 0 on: crossings from which the endless weave looks the same have the same."""
    matrix = weave.matrix
    seen: dict[bytes, int] = {}
    return np.array([
        [seen.setdefault(np.roll(matrix, (-j, -i), axis=(0, 1)).tobytes(), len(seen)) for i in range(weave.ends)]
        for j in range(weave.picks)
    ], dtype=np.int64)  # fmt: skip


def empty_cache(fabric: FabricParameters, tile: PatchScene, depth: int) -> RadianceCache:
    """A cache of a fabric that can learn."""
    units = tile.units_per_meter
    crossings = crossings_that_differ(fabric.weave)
    shape = (len(tile.materials), 2, LAYERS, int(crossings.max()) + 1, BOXES, BOXES)
    low, high = tile.z_range
    return RadianceCache(
        depth, (units * fabric.cell[0], units * fabric.cell[1]), low, high, shape, crossings,
        np.zeros((math.prod(shape), 3)), np.zeros((math.prod(shape), 6)),
    )  # fmt: skip


def learned(cache: RadianceCache, sums: Floats, systems: NDArray[np.int32]) -> RadianceCache:
    """The cache with the radiance that ``sums`` (V, 6) tell.

    Parameters
    ----------
    systems: (kinds,)
        Yarn systems of the kinds of fibers, as ``PatchScene.systems``. Fibers of a system that differ in albedo (in
        melange yarns) share how light is spread in space, each kind times its own factor.
    """
    boxes = sums.reshape(*cache.shape, 6)
    radiance = np.zeros((*cache.shape, 3))
    for system in range(len(SYSTEMS)):
        kinds = systems == system
        if not kinds.any():
            continue
        own = boxes[kinds]
        mean = _smoothed(own.sum(axis=0))
        # As the system's, but as bright as the kind's paths say.
        expected = np.sum(own[..., THROUGHPUT] * mean, axis=(2, 3, 4, 5), keepdims=True)
        found = np.sum(own[..., LIGHT], axis=(2, 3, 4, 5), keepdims=True)
        lean = LEAN * mean.mean(axis=(0, 1, 2, 3, 4))
        radiance[kinds] = mean * (found + lean) / np.maximum(expected + lean, 1e-300)
    return cache._replace(radiance=radiance.reshape(-1, 3), sums=np.zeros((0, 6)))


def _smoothed(boxes: Floats) -> Floats:
    """Means (2, layers, crossings, y, x, 3) of sums (..., 6): from the whole down to single boxes, each leans on the
    mean of those around it."""
    light, throughput = boxes[..., LIGHT], boxes[..., THROUGHPUT]
    mean = np.zeros(3)
    for axes in ((0, 1, 2, 3, 4), (1, 2, 3, 4), (2, 3, 4), (3, 4), ()):
        weight = throughput.sum(axis=axes, keepdims=True)
        mean = (light.sum(axis=axes, keepdims=True) + LEAN * mean) / (weight + LEAN)
    return mean
