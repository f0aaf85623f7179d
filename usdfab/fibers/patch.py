"""The patch: all fibers of one or several repeats of a fabric, periodic in x and y.

Frame: x along the weft, y along the warp, z the face normal, origin at the patch's lower left corner, mid-surface at
z = 0. Metres.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, System, YarnParameters
from usdfab.fibers.budget import PATH_TRACING_VERTICES as PATH_TRACING_VERTICES, affordable_variants, check_points
from usdfab.fibers.draws import Draws, draw, variation
from usdfab.fibers.fibers import YarnShape, fiber_offsets, successors
from usdfab.fibers.flyaways import OpenCurves, flyaway_counts, flyaway_offsets
from usdfab.fibers.segments import Layout, lay_out
from usdfab.fibers.shades import shaded_albedo

RASTERIZATION_VERTICES = 10
"""Vertices per segment for rasterization (Li et al. 2024, section 7.2)."""

FLYAWAY_VERTICES, MIN_FLYAWAY_VERTICES = 0.5, 8
"""Vertices on a flyaway, as a share of those on a segment and at least."""


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
    """Fibers of one patch, which repeats for ever with period ``size``.

    ``flyaways`` holds the open curves of the systems that have any. ``z_bounds`` overrides ``z_range``, where several
    patches are to stand in for each other.
    """

    size: tuple[float, float]
    warp: FiberSystem
    weft: FiberSystem
    flyaways: tuple[OpenCurves, ...] = ()
    z_bounds: tuple[float, float] | None = None

    @property
    def systems(self) -> tuple[FiberSystem, FiberSystem]:
        """(warp, weft)."""
        return self.warp, self.weft

    @property
    def curves(self) -> tuple[FiberSystem | OpenCurves, ...]:
        """The systems and their flyaways."""
        return (*self.systems, *self.flyaways)

    @cached_property
    def z_range(self) -> tuple[float, float]:
        """Lowest and highest place of any fiber's surface, flyaways included, metres."""
        if self.z_bounds is not None:
            return self.z_bounds
        low = min(float(s.points[:, 2].min()) - s.radius for s in self.curves)
        high = max(float(s.points[:, 2].max()) + s.radius for s in self.curves)
        return low, high


SIDE_BAND = 0.02
"""Cells next to the tile's border in which all variants are the same, at least (see also ``draws.BORDER_BAND``)."""


def generate_patch(
    fabric: FabricParameters,
    vertices_per_segment: int = PATH_TRACING_VERTICES,
    copies: tuple[int, int] = (1, 1),
    variant: int = 0,
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
    variant:
        0, or another number for a patch that can stand in for that of variant 0 anywhere: on and near the border it
        is the same, inside it differs. Fibers and flyaways that may cross the border are the same in all variants, so
        a patch of few cells varies little, and one of two by two cells hardly at all.

    Raises
    ------
    UsdfabError
        If the repeat is too large for memory (``budget.MAX_PATCH_POINTS``).
    """
    return _patch(yarn_systems(fabric, vertices_per_segment, copies), variant)


def patch_variants(
    fabric: FabricParameters,
    vertices_per_segment: int = PATH_TRACING_VERTICES,
    copies: tuple[int, int] = (1, 1),
    count: int | None = None,
) -> list[Patch]:
    """Variants 0, 1, ... of a fabric's patch (``generate_patch``), all with one ``z_range``.

    ``count`` is the fabric's own number of variants unless given, or as many as fit into memory. Errors as
    ``generate_patch``.
    """
    if count is None:
        count = affordable_variants(fabric, vertices_per_segment, copies)
    systems = yarn_systems(fabric, vertices_per_segment, copies, count)
    patches = [_patch(systems, variant) for variant in range(count)]
    low, high = min(p.z_range[0] for p in patches), max(p.z_range[1] for p in patches)
    return [replace(p, z_bounds=(low, high)) for p in patches]


@dataclass(frozen=True)
class YarnSystem:
    """What all variants of one yarn system have in common. ``size`` (2,) metres is the patch's.

    ``along_cell`` and ``across_cell`` are the sides of a cell along and across the yarns, metres.
    """

    name: System
    yarn: YarnParameters
    layout: Layout
    draws: Draws
    successor: NDArray[np.int64]
    along_cell: float
    across_cell: float
    size: tuple[float, float]
    seed: int
    vertices: int

    def fibers(self, variant: int) -> FiberSystem:
        """The fibers of a variant."""
        shape, layout, draws = YarnShape.of(self.yarn), self.layout, self.draws
        changes = None
        if variant:
            width = layout.yarns * self.across_cell
            middle = (np.arange(layout.yarns) + 0.5) * self.across_cell
            room = np.minimum(middle, width - middle) - self.radius - SIDE_BAND * self.across_cell
            half_width = self.yarn.radius * self.yarn.flattening
            margin = self.radius / self.along_cell + SIDE_BAND
            changes = variation(
                layout, draws, self.successor, self.seed, variant, room / half_width, margin,
                self.yarn.unevenness, self.yarn.waviness,
            )  # fmt: skip
        across, height = fiber_offsets(shape, layout, draws, self.successor, variation=changes)
        along = np.broadcast_to(layout.position * self.along_cell, across.shape)
        points = self._placed(along, across, height, layout.yarn)
        period = np.array([self.size[0], 0.0, 0.0]) if self.name == "weft" else np.array([0.0, self.size[1], 0.0])
        system = _by_curve(layout, points, self.successor, self.radius, period)
        return replace(system, albedo=self._albedo(system.yarn, system.fiber))

    def flyaways(self, variant: int) -> OpenCurves | None:
        """The flyaways of a variant, or None where there are none. Those that leave the patch are variant 0's."""
        length = self.along_cell * self.layout.length
        counts = flyaway_counts(self.yarn.flyaway_density, length, self.layout.yarns, self.seed, self.name)
        if counts.sum() == 0:
            return None
        owner = np.repeat(np.arange(self.layout.yarns), counts)
        number = np.concatenate([np.arange(c) for c in counts])
        common = self._flyaways(owner, number, 0)
        if variant == 0:
            return common
        other = self._flyaways(owner, number, variant)
        varies = self._is_inside(common) & self._is_inside(other)
        each = (-1, self.vertices, 3)
        points = np.where(varies[:, None, None], other.points.reshape(each), common.points.reshape(each))
        return replace(common, points=points.reshape(-1, 3), loop=np.where(varies, other.loop, common.loop))

    def _flyaways(self, owner: NDArray[np.int64], number: NDArray[np.int64], variant: int) -> OpenCurves:
        along, across, height, loop = flyaway_offsets(
            self.yarn, self.layout, self.draws, owner, number, self.along_cell, self.vertices, self.seed, variant
        )
        points = self._placed(along, across, height, owner[:, None])
        offsets = self.vertices * np.arange(len(owner) + 1)
        albedo = self._albedo(owner, number % self.draws.fibers)
        return OpenCurves(self.name, points.reshape(-1, 3), offsets, owner, number, loop, self.radius, albedo)

    def _albedo(self, yarn: NDArray[np.int64], fiber: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, 3) of fibers (N,) of yarns (N,)."""
        colors = np.asarray(self.yarn.colors())
        albedo = colors[yarn % len(colors)]
        shade = self.draws.shade
        return albedo if shade is None else shaded_albedo(albedo, self.yarn.albedo_variation, shade[yarn, fiber])

    def _is_inside(self, curves: OpenCurves) -> NDArray[np.bool_]:
        """Which curves do not come near the patch's border."""
        low, high = (b[:, :2] for b in curves.bounds)
        cell = (self.along_cell, self.across_cell) if self.name == "weft" else (self.across_cell, self.along_cell)
        margin = SIDE_BAND * np.asarray(cell)
        return np.all((low > margin) & (high < np.asarray(self.size) - margin), axis=1)

    @property
    def radius(self) -> float:
        """Radius of the fibers, metres."""
        return self.yarn.effective_fiber_radius

    def _placed(
        self, along: NDArray[np.float64], across: NDArray[np.float64], height: NDArray[np.float64], yarn: NDArray
    ) -> NDArray[np.float64]:
        """(..., 3) in the patch's frame from places relative to the yarns' straight axes."""
        # (x, y, z) is right-handed but (y, x, z) is left-handed; Z twist is to be positive in both systems.
        across = (across if self.name == "weft" else -across) + (yarn + 0.5) * self.across_cell
        first, second = (along, across) if self.name == "weft" else (across, along)
        return np.stack([first, second, height], axis=-1)


def yarn_systems(
    fabric: FabricParameters, vertices_per_segment: int, copies: tuple[int, int], variants: int = 1
) -> tuple[YarnSystem, YarnSystem]:
    """(warp, weft) of a patch, before any fiber is made; parameters and errors as ``patch_variants``."""
    if vertices_per_segment < 4:
        raise UsdfabError(f"{vertices_per_segment} vertices per segment are too few, at least 4 are needed")
    check_points(fabric, vertices_per_segment, copies, variants)
    picks, ends = fabric.repeat()
    picks, ends = picks * copies[1], ends * copies[0]
    weave = fabric.weave.tiled(picks // fabric.weave.picks, ends // fabric.weave.ends)
    dx, dy = fabric.cell

    def system(name: System) -> YarnSystem:
        yarn = fabric.system(name)
        layout = lay_out(weave, name, vertices_per_segment)
        draws = draw(layout, yarn.fiber_count, fabric.seed, yarn.ply_count, yarn.albedo_variation > 0.0)
        successor = successors(YarnShape.of(yarn), layout, draws)
        cells = (dx, dy) if name == "weft" else (dy, dx)
        vertices = max(MIN_FLYAWAY_VERTICES, round(FLYAWAY_VERTICES * vertices_per_segment))
        size = (ends * dx, picks * dy)
        return YarnSystem(name, yarn, layout, draws, successor, *cells, size, fabric.seed, vertices)

    return system("warp"), system("weft")


def _patch(systems: tuple[YarnSystem, YarnSystem], variant: int) -> Patch:
    if variant < 0:
        raise ValueError(f"variants are numbered from 0, not {variant}")
    with ThreadPoolExecutor(2) as pool:
        warp, weft = pool.map(lambda s: s.fibers(variant), systems)
    flyaways = tuple(f for f in (s.flyaways(variant) for s in systems) if f is not None)
    return Patch(systems[0].size, warp, weft, flyaways)


def _by_curve(
    layout: Layout,
    points: NDArray[np.float64],
    successor: NDArray[np.int64],
    radius: float,
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
        albedo=np.ones((len(yarn), 3)),
        period=period,
    )
