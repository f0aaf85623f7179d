"""Fibers as cubic B-splines for USD: of whole tiles, and of pieces of tiles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fibers import FiberSystem, OpenCurves, Patch
from usdfab.usd.expand.divide import Tiling

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bounds = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True, eq=False)
class FiberCurves:
    """Nonperiodic cubic B-splines of one yarn system.

    ``name`` Warp, Weft, WarpFlyaways or WeftFlyaways; ``system`` warp or weft; ``points`` (N, 3) metres; ``counts``,
    ``yarn``, ``fiber`` (curves,); ``color`` (curves, 3) the fiber albedo, or (N, 3) where it varies along curves.
    """

    name: str
    system: str
    points: Floats
    counts: Ints
    yarn: Ints
    fiber: Ints
    color: Floats
    radius: float

    @property
    def offsets(self) -> Ints:
        """(curves + 1,) first point of each curve."""
        return np.r_[0, np.cumsum(self.counts)]


def tile_curves(patch: Patch, overlap: float = 0.0) -> Iterator[FiberCurves]:
    """Curves of a whole tile, in its frame. Flyaways are numbered on from the fibers of their yarn.

    A nonperiodic cubic B-spline runs from its second knot to its last but one. With one control point of the curve
    before it and two of the curve after it, a fiber runs from its own first vertex's knot to the knot of its
    successor's; more of them let it overlap by ``overlap`` metres or a little more.
    """
    for system in patch.systems:
        spacing = _spacing(system)
        more = min(int(np.ceil(overlap / spacing)), int(np.diff(system.offsets).min()) - 2) if overlap > 0 else 0
        points, offsets = system.extended(1 + more, 2 + more)
        yield _curves(system.system.capitalize(), system, points, offsets, system.fiber)
    fibers = {system.system: int(system.fiber.max()) + 1 for system in patch.systems}
    for flyaways in patch.flyaways:
        points, offsets = flyaways.pinned()
        name = f"{flyaways.system.capitalize()}Flyaways"
        yield _curves(name, flyaways, points, offsets, fibers[flyaways.system] + flyaways.number)


def piece_curves(curves: FiberCurves, tiling: Tiling, cells: Bounds, overlap: float) -> FiberCurves:
    """What a piece holds of its tile's curves, about the piece's centre.

    Parameters
    ----------
    curves:
        Of the tile, prolonged by ``overlap`` at least.
    cells:
        ((first, last) column, (first, last) row) of the piece.
    overlap: metres
        Fibers go on beyond the piece's border by so much, up to the next knot. Yarns are not split lengthwise; a
        flyaway belongs to the piece in which it starts.
    """
    axis, cell = 0 if curves.system == "weft" else 1, tiling.cell
    low, high = (cells[axis][k] * cell[axis] for k in (0, 1))
    across = cells[1 - axis]
    mine = (curves.yarn >= across[0]) & (curves.yarn < across[1])
    along = curves.points[:, axis]
    if curves.name.endswith("Flyaways"):
        # Their embedded ends may reach beyond the tile, which has no piece there.
        start = np.clip(along[curves.offsets[:-1] + 1], 0.5 * cell[axis], tiling.size[axis] - 0.5 * cell[axis])
        mine &= (start >= low) & (start < high)
        keep = np.repeat(mine, curves.counts)
    else:
        keep = np.repeat(mine, curves.counts) & _between(along, curves, low - overlap, high + overlap)
    counts = np.add.reduceat(keep.astype(np.int64), curves.offsets[:-1])
    chosen = counts > 0
    middle = np.array([0.5 * sum(cells[0]) * cell[0], 0.5 * sum(cells[1]) * cell[1], 0.0])
    color = curves.color[chosen]
    return FiberCurves(
        curves.name, curves.system, curves.points[keep] - middle, counts[chosen], curves.yarn[chosen],
        curves.fiber[chosen], color, curves.radius,
    )  # fmt: skip


def _between(along: Floats, curves: FiberCurves, low: float, high: float) -> NDArray[np.bool_]:
    """(N,) the control points with which curves run from the last knot before ``low`` to the first after ``high``."""
    tiny = 1e-6 * max(high - low, 1e-12)
    number = np.arange(len(along))
    owner = np.repeat(np.arange(len(curves.counts)), curves.counts)
    before = np.maximum(number - 2, curves.offsets[:-1][owner])
    after = np.minimum(number + 2, curves.offsets[1:][owner] - 1)
    return (along[after] > low + tiny) & (along[before] < high - tiny)


def _spacing(system: FiberSystem) -> float:
    """Greatest distance of control points along the yarns."""
    axis = int(np.argmax(np.abs(system.period)))
    step = np.diff(system.points[:, axis])
    return float(step[step > 0].max())


def _curves(name: str, system: FiberSystem | OpenCurves, points: Floats, offsets: Ints, fiber: Ints) -> FiberCurves:
    return FiberCurves(
        name, system.system, points, np.diff(offsets), system.yarn, np.asarray(fiber), system.albedo, system.radius
    )
