"""The parameters of a fabric as one vector without bounds, which gradient descent may move anywhere.

Every number runs within the soft range of the parameter table. Where that spans more than a factor of ``LOG_SPAN``
above 0, as lengths do, its logarithm is mapped, so that a step is a ratio. The map is a sigmoid on the range, the
exposure's an exponential.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.optics import ROUGHNESSES, Optics, optics_of, with_optics
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fibers.fibers import YarnShape
from usdfab.fit.raster.curves import Shapes
from usdfab.fit.raster.shade import Look

SHAPE_NAMES = ("inclination", "crimp", "twist", "irregularity", "radius", "flattening")
"""What stage 2 moves of each yarn system's shape, as fields of ``YarnParameters``."""

LOOK_NAMES = ("albedo", "diffuse", *ROUGHNESSES, "gain")
"""What stage 2 moves of the look: C, k_d, gamma_M, gamma_N, gamma_M0 and the exposure."""

FREE_NAMES = (*SHAPE_NAMES, *LOOK_NAMES)

LOG_SPAN = 50.0
MARGIN = 1e-3
"""A start on the border of its range is moved inwards by this part of the range: there a sigmoid has no slope."""

STEPS = {"radius": 0.2, "roughness_primary": 0.3}
"""How far a step moves these, compared with the others. Their ranges are wide beside what a start is uncertain by: a
full step of the radius would be 6 % at a rate of 0.05, and gamma_M0, of which a picture says little, would wander."""

DIFFUSE_RANGE = (0.0, 1.0)
"""k_d: what a surface reflects diffusely."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """A fabric's free numbers: their names, ranges and maps.

    Parameters
    ----------
    fabric:
        Where the fixed numbers come from.
    names: (P,)
        ``warp.inclination``, ..., ``weft.albedo[0].g``, ``weft.diffuse[0].g``, ``warp.roughness_primary``, ``gain``.
    low, high: (P,) tensors
        Ranges, logarithms where ``log``; the exposure has none, (-inf, inf).
    log: (P,) bool tensor
    step: (P,) tensor
        Slopes of the sigmoids, relative to each other: ``STEPS``.
    start: (P,) tensor
        Natural values.
    free: (F,) int64 tensor
        Which of them move.
    """

    fabric: FabricParameters
    names: tuple[str, ...]
    low: Tensor
    high: Tensor
    log: Tensor
    step: Tensor
    start: Tensor
    free: Tensor

    @property
    def free_names(self) -> tuple[str, ...]:
        """Of the entries of ``vector()``."""
        return tuple(self.names[k] for k in self.free.tolist())

    def vector(self) -> Tensor:
        """(F,) float64: the start, without bounds; the inverse of :meth:`natural`."""
        value = torch.where(self.log, self.start.clamp(min=1e-300).log(), self.start)
        share = ((value - self.low) / (self.high - self.low)).clamp(MARGIN, 1.0 - MARGIN)
        return (torch.where(self.high.isinf(), value, torch.logit(share)) / self.step)[self.free]

    def natural(self, vector: Tensor) -> Tensor:
        """(P,) all numbers in their units, the fixed ones as at the start; differentiable in ``vector`` (F,)."""
        low, high, log = self.low[self.free], self.high[self.free], self.log[self.free]
        unbounded, scaled = high.isinf(), vector * self.step[self.free]
        # No infinities in the branch that is not taken: 0 times infinity is no number.
        base, span = low.where(~unbounded, 0.0), (high - low).where(~unbounded, 0.0)
        value = torch.where(unbounded, scaled, base + span * torch.sigmoid(scaled))
        # Likewise no exponential of what is no logarithm.
        value = torch.where(log, torch.where(log, value, 0.0).exp(), value)
        return self.start.index_copy(0, self.free, value)

    def of(self, natural: Tensor) -> tuple[Shapes, Look]:
        """Shapes (warp, weft) and look of the raster renderer, of all numbers (P,) in their units."""
        by_name = dict(zip(self.names, natural, strict=True))
        shapes = []
        for system in SYSTEMS:
            yarn = self.fabric.system(system)
            values = {
                name: by_name[f"{system}.{name}"]
                if name in SHAPE_NAMES
                else torch.tensor(float(getattr(yarn, name)), dtype=torch.float64)
                for name in YarnShape.__dataclass_fields__
            }
            shapes.append(YarnShape(**values))
        first = len(SYSTEMS) * len(SHAPE_NAMES)
        colors = len(optics_of(self.fabric).albedo)
        albedo, diffuse, roughness, gain = natural[first:].split([3 * colors, 3 * colors, 6, 1])
        ior = torch.from_numpy(optics_of(self.fabric).ior)
        return (shapes[0], shapes[1]), Look(
            albedo.reshape(-1, 3), diffuse.reshape(-1, 3), roughness.reshape(2, 3), ior, gain[0]
        )

    def fabric_of(self, natural: Tensor) -> FabricParameters:
        """The fabric with these numbers, (P,) in their units; it has no k_d and no exposure."""
        shapes, look = self.of(natural.detach())
        changed = {
            system: replace(self.fabric.system(system), **{n: float(getattr(shape, n)) for n in SHAPE_NAMES})  # type: ignore[arg-type]
            for system, shape in zip(SYSTEMS, shapes, strict=True)
        }
        old = optics_of(self.fabric)
        fabric = replace(self.fabric, **changed)  # type: ignore[arg-type]
        return with_optics(fabric, Optics(look.albedo.numpy(), old.system, look.roughness.numpy(), old.ior))


def parameters_of(
    fabric: FabricParameters,
    diffuse: float | NDArray[np.float64] = 0.3,
    gain: float = 1.0,
    free: Sequence[str] = FREE_NAMES,
) -> Parameters:
    """The numbers of ``fabric`` that stage 2 moves.

    Parameters
    ----------
    diffuse:
        k_d, of every colour or (K, 3), rows as ``optics_of(fabric).albedo``.
    gain:
        Exposure, above 0.
    free:
        Which of ``FREE_NAMES`` move, in both systems and every colour; the others stay.

    Raises
    ------
    UsdfabError
        For an unknown name, and for a free number outside its range.
    """
    unknown = [name for name in free if name not in FREE_NAMES]
    if unknown or not free:
        raise UsdfabError(f"the raster stage cannot move '{', '.join(unknown)}'", remedy=", ".join(FREE_NAMES))
    optics = optics_of(fabric)
    every = np.broadcast_to(np.asarray(diffuse, dtype=np.float64), optics.albedo.shape)
    rows: list[tuple[str, str, float]] = [
        (f"{s}.{name}", name, float(getattr(fabric.system(s), name))) for s in SYSTEMS for name in SHAPE_NAMES
    ]
    for kind, values in (("albedo", optics.albedo), ("diffuse", every)):
        labels = [n.replace("albedo", kind) for n in optics.names() if "albedo" in n]
        rows += [(label, kind, float(v)) for label, v in zip(labels, values.ravel(), strict=True)]
    rows += [
        (f"{s}.{name}", name, float(optics.roughness[k, column]))
        for k, s in enumerate(SYSTEMS)
        for column, name in enumerate(ROUGHNESSES)
    ]
    rows.append(("gain", "gain", float(gain)))
    ranges = [_range(kind) for _, kind, _ in rows]
    moving = [k for k, (_, kind, _) in enumerate(rows) if kind in free]
    for k in moving:
        name, kind, value = rows[k]
        low, high = soft_range(kind)
        if not low <= value <= high or not math.isfinite(value) or (ranges[k][2] and value <= 0.0):
            raise UsdfabError(
                f"{name} starts at {value:g}, outside its range",
                remedy=f"start between {low:g} and {high:g}",
            )
    lows, highs, logs = (torch.tensor([r[i] for r in ranges], dtype=torch.float64) for i in range(3))
    return Parameters(
        fabric,
        tuple(name for name, _, _ in rows),
        lows,
        highs,
        logs.bool(),
        torch.tensor([STEPS.get(kind, 1.0) for _, kind, _ in rows], dtype=torch.float64),
        torch.tensor([value for _, _, value in rows], dtype=torch.float64),
        torch.tensor(moving),
    )


def soft_range(kind: str) -> tuple[float, float]:
    """Where a parameter of ``FREE_NAMES`` may run, in its units."""
    if kind == "gain":
        return 0.0, math.inf
    if kind == "diffuse":
        return DIFFUSE_RANGE
    return PARAMETER_BY_NAME[kind].soft


def within_ranges(fabric: FabricParameters) -> tuple[FabricParameters, tuple[str, ...]]:
    """``fabric`` with what stage 2 moves clipped to its ranges, and the names of what was outside."""
    outside: list[str] = []
    changed: dict[str, object] = {}
    for system in SYSTEMS:
        yarn = fabric.system(system)
        values: dict[str, float] = {}
        for name in (*SHAPE_NAMES, *ROUGHNESSES):
            low, high = soft_range(name)
            value = float(getattr(yarn, name))
            if not low <= value <= high:
                values[name] = min(max(value, low), high)
                outside.append(f"{system}.{name}")
        changed[system] = replace(yarn, **values)  # type: ignore[arg-type]
    return replace(fabric, **changed), tuple(outside)  # type: ignore[arg-type]


def _range(kind: str) -> tuple[float, float, bool]:
    """Low and high as they are mapped, and whether as logarithms."""
    low, high = soft_range(kind)
    if math.isinf(high):
        return -math.inf, math.inf, True
    if low > 0.0 and high > LOG_SPAN * low:
        return math.log(low), math.log(high), True
    return low, high, False
