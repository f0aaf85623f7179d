"""The fibers of a periodic patch as polylines in torch, differentiable in the shape of the yarns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fabric.plies import ply_fill
from usdfab.fibers.fibers import YarnShape, fiber_offsets
from usdfab.fibers.patch import RASTERIZATION_VERTICES, YarnSystem, yarn_systems

MAX_VERTICES = 6_000_000
"""Most vertices of a patch: gradients take about a kilobyte each."""

_TANGENT_FLOOR = 1e-30


@dataclass(frozen=True)
class Polylines:
    """Where the fibers of a patch are. V vertices, each the start of a segment.

    ``points`` (V, 3) patch frame, metres; ``tangents`` (V, 3) unit vectors; ``radius`` (2,) of the fibers of warp and
    weft, metres. All carry gradients.
    """

    points: Tensor
    tangents: Tensor
    radius: Tensor


class CurveModel:
    """The fibers of a fabric's patch with their random draws fixed.

    Attributes
    ----------
    size: (2,) metres
        Of the patch, its period along x and y.
    following, preceding: (V,) int64
        The vertex at which a vertex's segment ends, and the one whose segment ends at it.
    following_shift, preceding_shift: (V, 2) int64
        In which copy of the patch those lie: 0, or 1 or -1 along the yarns.
    system, color, curve: (V,) int64
        0 warp or 1 weft, row of ``optics_of(fabric).albedo``, number of the fiber.
    """

    def __init__(
        self,
        fabric: FabricParameters,
        copies: tuple[int, int],
        vertices_per_segment: int = RASTERIZATION_VERTICES,
    ) -> None:
        """Lay out the patch: ``copies`` of the weave's repeat along x and y.

        Raises
        ------
        UsdfabError
            If the patch has too many vertices.
        """
        self.fabric = fabric
        self._systems = yarn_systems(fabric, vertices_per_segment, copies)
        self.size = self._systems[0].size
        count = sum(s.draws.fibers * len(s.layout.yarn) for s in self._systems)
        if count > MAX_VERTICES:
            raise UsdfabError(
                f"the patch has {count:.2g} vertices, above {MAX_VERTICES:.2g}",
                remedy="fit a fabric with fewer fibers or a smaller repeat",
            )
        colors = optics_of(fabric)
        self._order: list[Tensor] = []
        tables: dict[str, list[NDArray[np.int64]]] = {
            k: [] for k in ("next", "before", "next_shift", "before_shift", "system", "color", "curve")
        }
        base = curves = 0
        for index, system in enumerate(self._systems):
            yarn_albedo = fabric.system(SYSTEMS[index]).colors()
            rows = np.flatnonzero(colors.system == index)
            row_of = {tuple(colors.albedo[row].tolist()): int(row) for row in rows}
            topology = _topology(system)
            self._order.append(torch.from_numpy(topology.order))
            axis = 1 if system.name == "warp" else 0
            for name, (vertex, wraps) in (("next", topology.following), ("before", topology.preceding)):
                tables[name].append(vertex + base)
                shift = np.zeros((len(vertex), 2), dtype=np.int64)
                shift[:, axis] = wraps
                tables[f"{name}_shift"].append(shift)
            tables["system"].append(np.full(len(topology.order), index))
            yarn_rows = np.array([row_of[tuple(float(c) for c in color)] for color in yarn_albedo])
            tables["color"].append(yarn_rows[topology.yarn % len(yarn_rows)])
            tables["curve"].append(topology.curve + curves)
            base += len(topology.order)
            curves += int(topology.curve.max()) + 1
        joined = {name: np.concatenate(parts) for name, parts in tables.items()}
        self.following, self.preceding = joined["next"], joined["before"]
        self.following_shift, self.preceding_shift = joined["next_shift"], joined["before_shift"]
        self.system, self.color, self.curve = joined["system"], joined["color"], joined["curve"]
        self._next, self._before = torch.from_numpy(self.following), torch.from_numpy(self.preceding)
        period = torch.tensor([*self.size, 0.0], dtype=torch.float64)
        pad = torch.nn.functional.pad
        self._step = pad(torch.from_numpy(self.following_shift), (0, 1)) * period
        self._back = pad(torch.from_numpy(self.preceding_shift), (0, 1)) * period

    @property
    def vertices(self) -> int:
        """Number of vertices, and of segments."""
        return len(self.system)

    def shapes(self) -> tuple[YarnShape, YarnShape]:
        """The shape parameters (warp, weft) of the fabric itself, as float64 tensors."""
        return tuple(  # type: ignore[return-value]
            YarnShape(**{
                name: torch.tensor(float(getattr(self.fabric.system(s), name)), dtype=torch.float64)
                for name in YarnShape.__dataclass_fields__
            })
            for s in SYSTEMS
        )  # fmt: skip

    def fiber_radius(self, system: int, shape: YarnShape) -> Tensor:
        """Radius of the fibers, metres: the given one, or from the packing of the cross-section."""
        yarn = self.fabric.system(SYSTEMS[system])
        if yarn.fiber_radius > 0:
            return torch.tensor(yarn.fiber_radius, dtype=torch.float64)
        filled = shape.flattening * (yarn.packing * ply_fill(yarn.ply_count) / yarn.fiber_count)
        return shape.radius * torch.sqrt(filled)

    def __call__(self, shapes: tuple[YarnShape, YarnShape]) -> Polylines:
        """The fibers with the given shapes (warp, weft): numbers or 0-d float64 tensors."""
        placed = [self._placed(system, shape) for system, shape in zip(self._systems, shapes, strict=True)]
        points = torch.cat([p[order] for p, order in zip(placed, self._order, strict=True)])
        chord = points[self._next] + self._step - points[self._before] - self._back
        tangents = chord / torch.sqrt((chord * chord).sum(dim=1, keepdim=True) + _TANGENT_FLOOR)
        radius = torch.stack([self.fiber_radius(k, shape) for k, shape in enumerate(shapes)])
        return Polylines(points, tangents, radius)

    @staticmethod
    def _placed(system: YarnSystem, shape: YarnShape) -> Tensor:
        """(fibers * stations, 3), metres."""
        across, height = fiber_offsets(shape, system.layout, system.draws, system.successor, xp=torch)
        middle = torch.from_numpy((system.layout.yarn + 0.5) * system.across_cell)
        along = torch.from_numpy(system.layout.position * system.along_cell).expand_as(across)
        # As ``YarnSystem`` places them: positive twist is Z in both systems.
        if system.name == "weft":
            return torch.stack([along, middle + across, height], dim=-1).reshape(-1, 3)
        return torch.stack([middle - across, along, height], dim=-1).reshape(-1, 3)


@dataclass(frozen=True)
class _Topology:
    """Vertices of one system, curve by curve: (V,) places in (fibers, stations), neighbours, yarn and curve."""

    order: NDArray[np.int64]
    following: tuple[NDArray[np.int64], NDArray[np.int64]]
    preceding: tuple[NDArray[np.int64], NDArray[np.int64]]
    yarn: NDArray[np.int64]
    curve: NDArray[np.int64]


def _topology(system: YarnSystem) -> _Topology:
    layout, fibers = system.layout, system.draws.fibers
    stations = len(layout.yarn)
    order, yarn, fiber, length, start = [], [], [], [], []
    base = 0
    for k in range(layout.yarns):
        own = np.arange(layout.first[k], layout.first[k + 1])
        order.append((np.arange(fibers)[:, None] * stations + own).ravel())
        yarn.append(np.full(fibers, k))
        fiber.append(np.arange(fibers))
        length.append(np.full(fibers, len(own)))
        start.append(base + np.arange(fibers) * len(own))
        base += fibers * len(own)
    first, count, of_yarn = np.concatenate(start), np.concatenate(length), np.concatenate(yarn)
    curve = np.repeat(np.arange(len(first)), count)
    successor = (system.successor + fibers * np.arange(layout.yarns)[:, None]).ravel()
    predecessor = np.empty_like(successor)
    predecessor[successor] = np.arange(len(successor))
    last = first + count - 1
    following, preceding = np.arange(base) + 1, np.arange(base) - 1
    wraps_on, wraps_back = np.zeros(base, dtype=np.int64), np.zeros(base, dtype=np.int64)
    following[last], wraps_on[last] = first[successor], 1
    preceding[first], wraps_back[first] = last[predecessor], -1
    return _Topology(
        np.concatenate(order), (following, wraps_on), (preceding, wraps_back), of_yarn[curve], curve
    )  # fmt: skip


def raster_copies(fabric: FabricParameters, cells: int) -> tuple[int, int]:
    """Repeats of the weave along x and y so that a patch has at least ``cells`` cells each way."""
    picks, ends = fabric.repeat()
    return max(1, math.ceil(cells / ends)), max(1, math.ceil(cells / picks))


Shapes = tuple[YarnShape, YarnShape]
"""Of warp and weft."""


def as_numpy(tensor: Any) -> NDArray:
    """Values of a tensor, cut off from its gradient."""
    return tensor.detach().cpu().numpy()
