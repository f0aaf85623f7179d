"""The patch: all fibers of one or several repeats of a fabric, periodic in x and y.

Frame: x along the weft, y along the warp, z the face normal, origin at the patch's lower left corner, mid-surface at
z = 0. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, System
from usdfab.fibers.draws import draw
from usdfab.fibers.fibers import YarnShape, fiber_offsets, successors
from usdfab.fibers.segments import Layout, lay_out

PATH_TRACING_VERTICES = 40
"""Vertices per segment for path tracing (Li et al. 2024, section 6.1)."""

RASTERIZATION_VERTICES = 10
"""Vertices per segment for rasterization (Li et al. 2024, section 7.2)."""


@dataclass(frozen=True)
class FiberSystem:
    """The fibers of one yarn system. Curves are ordered by yarn, then fiber.

    Parameters
    ----------
    points: (N, 3) float64, metres
        Vertices of all curves, one curve after the other. A curve covers one period; its first vertex is not repeated.
    offsets: (curves + 1,) int64
        First vertex of each curve.
    yarn, fiber: (curves,) int64
        Which yarn of the patch, which fiber of the yarn.
    successor: (curves,) int64
        The curve that goes on where this one ends, in the next patch along ``period``.
    radius: metres
        Radius of the fibers.
    albedo: (curves, 3)
        Fiber albedo coefficient C, linear Rec. 709.
    period: (3,) metres
        From a patch to the next one along the yarns.
    """

    system: System
    points: NDArray[np.float64]
    offsets: NDArray[np.int64]
    yarn: NDArray[np.int64]
    fiber: NDArray[np.int64]
    successor: NDArray[np.int64]
    radius: float
    albedo: NDArray[np.float64]
    period: NDArray[np.float64]

    @property
    def curves(self) -> int:
        """Number of curves."""
        return len(self.yarn)

    @cached_property
    def predecessor(self) -> NDArray[np.int64]:
        """(curves,) the curve whose end this one's start continues."""
        inverse = np.empty_like(self.successor)
        inverse[self.successor] = np.arange(self.curves)
        return inverse

    def extended(self, before: int, after: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Curves prolonged by vertices of their neighbours in the previous and next patch.

        Returns
        -------
        points: (M, 3) metres, offsets: (curves + 1,)
        """
        lengths = np.diff(self.offsets)
        if before > lengths.min() or after > lengths.min():
            raise ValueError("a curve cannot be prolonged by more than one period")
        new_offsets = np.r_[0, np.cumsum(lengths + before + after)]
        out = np.empty((new_offsets[-1], 3))
        curve = np.repeat(np.arange(self.curves), lengths)
        place = np.arange(len(self.points)) - self.offsets[:-1][curve]
        out[new_offsets[:-1][curve] + before + place] = self.points
        every = np.arange(self.curves)
        for k in range(before):
            source = self.offsets[1:][self.predecessor] - before + k
            out[new_offsets[:-1][every] + k] = self.points[source] - self.period
        for k in range(after):
            source = self.offsets[:-1][self.successor] + k
            out[new_offsets[1:][every] - after + k] = self.points[source] + self.period
        return out, new_offsets


@dataclass(frozen=True)
class Patch:
    """Fibers of one patch, which repeats for ever with period ``size``."""

    size: tuple[float, float]
    warp: FiberSystem
    weft: FiberSystem

    @property
    def systems(self) -> tuple[FiberSystem, FiberSystem]:
        """(warp, weft)."""
        return self.warp, self.weft

    @cached_property
    def z_range(self) -> tuple[float, float]:
        """Lowest and highest place of any fiber's surface, metres."""
        low = min(float(s.points[:, 2].min()) - s.radius for s in self.systems)
        high = max(float(s.points[:, 2].max()) + s.radius for s in self.systems)
        return low, high


def generate_patch(
    fabric: FabricParameters,
    vertices_per_segment: int = PATH_TRACING_VERTICES,
    copies: tuple[int, int] = (1, 1),
) -> Patch:
    """The periodic patch of a fabric.

    Parameters
    ----------
    fabric:
        What to build.
    vertices_per_segment:
        Vertices on each segment of each fiber.
    copies:
        Repeats along x and y that the patch holds, each with randomness of its own.
    """
    if vertices_per_segment < 4:
        raise UsdfabError(f"{vertices_per_segment} vertices per segment are too few, at least 4 are needed")
    picks, ends = fabric.repeat()
    picks, ends = picks * copies[1], ends * copies[0]
    weave = fabric.weave.tiled(picks // fabric.weave.picks, ends // fabric.weave.ends)
    dx, dy = fabric.cell
    systems = {}
    for name in ("warp", "weft"):
        yarn = fabric.system(name)
        layout = lay_out(weave, name, vertices_per_segment)
        draws = draw(layout, yarn.fiber_count, fabric.seed, yarn.ply_count)
        shape = YarnShape.of(yarn)
        successor = successors(shape, layout, draws)
        across, height = fiber_offsets(shape, layout, draws, successor)
        along_cell, across_cell = (dx, dy) if name == "weft" else (dy, dx)
        along = np.broadcast_to(layout.position * along_cell, across.shape)
        # (x, y, z) is right-handed but (y, x, z) is left-handed; Z twist is to be positive in both systems.
        across = (across if name == "weft" else -across) + (layout.yarn + 0.5) * across_cell
        first, second = (along, across) if name == "weft" else (across, along)
        points = np.stack([first, second, height], axis=-1)
        colors = np.asarray(yarn.colors())
        period = np.array([ends * dx, 0.0, 0.0]) if name == "weft" else np.array([0.0, picks * dy, 0.0])
        systems[name] = _by_curve(layout, points, successor, yarn.effective_fiber_radius, colors, period)
    return Patch((ends * dx, picks * dy), systems["warp"], systems["weft"])


def _by_curve(
    layout: Layout,
    points: NDArray[np.float64],
    successor: NDArray[np.int64],
    radius: float,
    colors: NDArray[np.float64],
    period: NDArray[np.float64],
) -> FiberSystem:
    """From (fibers, stations, 3) to one curve after the other, yarn by yarn."""
    fibers = points.shape[0]
    lengths = np.repeat(np.diff(layout.first), fibers)
    pieces = [points[:, layout.first[k] : layout.first[k + 1]].reshape(-1, 3) for k in range(layout.yarns)]
    yarn = np.repeat(np.arange(layout.yarns), fibers)
    return FiberSystem(
        system=layout.system,
        points=np.concatenate(pieces),
        offsets=np.r_[0, np.cumsum(lengths)],
        yarn=yarn,
        fiber=np.tile(np.arange(fibers), layout.yarns),
        successor=(successor + fibers * np.arange(layout.yarns)[:, None]).ravel(),
        radius=radius,
        albedo=colors[yarn % len(colors)],
        period=period,
    )
