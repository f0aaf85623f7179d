"""The coordinates of the match stage: numbers of a fabric and the exposure, each measured in steps from a start.

A step is about what a glance can tell apart, so that coordinates are alike in size and one damping suits them all.
Lengths, counts and roughnesses move by factors, albedos by their logit, the density of flyaways by its square root,
for it may be 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, Color, FabricParameters, System, YarnParameters
from usdfab.imaging.lens import PIVOT

if TYPE_CHECKING:
    from usdfab.fit.texture import Target

Floats = NDArray[np.float64]
Scale = Literal["linear", "log", "sqrt", "logit"]

EXPOSURE = "exposure"
EXPOSURE_STEP = 0.15
"""Of the exposure's logarithm."""

BLUR = "blur"
BLUR_STEP = 0.25
"""Of the camera's ``b |b|``, in which pictures are smooth at 0, in squared units of ``BLUR_UNIT``."""
BLUR_UNIT = 1.0 / 240.0
"""Of the photo's width: a pixel of the pictures by which fits are judged. Photos are enlarged, out of focus, sharpened
by about so much."""
BLUR_RANGE = (-1.5, 4.0)
"""Of ``b |b|``: twice the unit is where fibers are gone; sharper than the lower end, seams show."""

CONTRAST = "contrast"
CONTRAST_STEP = 0.1
"""Of the camera's contrast's logarithm."""
CONTRAST_RANGE = (0.6, 1.8)

LEAST_LEVEL = 1e-3
"""Of a photo that is not black."""

OF_THE_CAMERA = (BLUR, CONTRAST, EXPOSURE)
"""Coordinates of the photo, not of the cloth: another picture is not needed to see what they do."""

CHANNELS = "rgb"


@dataclass(frozen=True)
class Move:
    """How one number of a yarn system moves.

    Parameters
    ----------
    scale, step:
        What is added for one step to the value, its logarithm, square root or logit.
    low, high:
        Where it stops.
    spread:
        Standard deviation of the prior about the start, in steps.
    """

    scale: Scale
    step: float
    low: float
    high: float
    spread: float = 3.0

    def moved(self, value: float, steps: float) -> float:
        """``value`` after ``steps``, within the range (or where it was, if that is outside)."""
        if steps == 0.0:
            return value
        low, high = min(self.low, value), max(self.high, value)
        if self.scale == "linear":
            result = value + self.step * steps
        elif self.scale == "log":
            result = value * math.exp(self.step * steps)
        elif self.scale == "sqrt":
            result = max(math.sqrt(value) + self.step * steps, 0.0) ** 2
        else:
            inner = min(max(value, self.low), self.high)
            result = 1.0 / (1.0 + (1.0 / inner - 1.0) * math.exp(-self.step * steps))
        return min(max(result, low), high)

    def deviation(self, value: float, steps: float) -> float:
        """A standard deviation of ``steps`` at ``value``, in its own unit."""
        return 0.5 * abs(self.moved(value, steps) - self.moved(value, -steps))


MOVES: dict[str, Move] = {
    "radius": Move("log", 0.06, 2e-5, 2e-3),
    "flattening": Move("log", 0.15, 1.0, 4.0),
    "inclination": Move("log", 0.25, 0.1, 1.5),
    "crimp": Move("log", 0.15, 0.1, 1.5),
    "twist": Move("linear", 0.06, -0.6, 0.6),
    "unevenness": Move("sqrt", 0.08, 0.0, 0.35),
    "waviness": Move("sqrt", 0.1, 0.0, 0.6),
    "irregularity": Move("log", 0.4, 0.02, 0.6),
    "fiber_count": Move("log", 0.25, 20, 400),
    "flyaway_density": Move("sqrt", 20.0, 0.0, 2e4, spread=2.0),
    "flyaway_length": Move("log", 0.3, 1e-4, 3e-3),
    "albedo_variation": Move("sqrt", 0.15, 0.0, 1.5, spread=2.0),
    "roughness_longitudinal": Move("log", 0.25, 0.1, 0.9),
    "roughness_azimuthal": Move("log", 0.25, 0.05, 0.6),
    "roughness_primary": Move("log", 0.3, 0.05, 0.9),
    "albedo": Move("logit", 0.4, 0.003, 0.995, spread=5.0),
}
"""Names of ``YarnParameters``. Albedos move channel by channel, all colours of a yarn-dyed system together."""


@dataclass(frozen=True, eq=False)
class MatchSpace:
    """Coordinates about a start.

    Parameters
    ----------
    start:
        The fabric at coordinates 0.
    names: (P,)
        ``warp.radius``, ..., ``weft.albedo.b``, ``blur``, ``contrast``, ``exposure``.
    light:
        The exposure at coordinates 0.
    blur, contrast:
        The rig's at coordinates 0.
    level:
        Light in a photo that more or less contrast leaves as bright as it is: the exposure follows. About the photo's
        mean, so that contrast and exposure are not two names for one thing.
    """

    start: FabricParameters
    names: tuple[str, ...]
    light: float = 1.0
    blur: float = 0.0
    contrast: float = 1.0
    level: float = PIVOT

    @classmethod
    def about(
        cls,
        start: FabricParameters,
        free: Sequence[str] = (*MOVES, *OF_THE_CAMERA),
        light: float = 1.0,
        blur: float = 0.0,
        contrast: float = 1.0,
        level: float = PIVOT,
    ) -> MatchSpace:
        """All coordinates of the parameters named.

        Raises
        ------
        UsdfabError
            For a name that is neither in ``MOVES`` nor in ``OF_THE_CAMERA``.
        """
        for name in free:
            if name not in MOVES and name not in OF_THE_CAMERA:
                raise UsdfabError(f"the match stage moves no '{name}'", remedy=f"choose from {', '.join(MOVES)}")
        names = [
            f"{system}.{name}{part}"
            for system in SYSTEMS
            for name in MOVES
            if name in free
            for part in ([f".{c}" for c in CHANNELS] if name == "albedo" else [""])
        ]
        return cls(start, (*names, *(name for name in OF_THE_CAMERA if name in free)), light, blur, contrast, level)

    @property
    def spread(self) -> Floats:
        """(P,) standard deviations of the prior, in steps."""
        return np.array([3.0 if n in OF_THE_CAMERA else MOVES[n.split(".")[1]].spread for n in self.names])

    def fabric(self, point: Floats) -> FabricParameters:
        """The fabric at a point (P,)."""
        steps = dict(zip(self.names, np.asarray(point, dtype=np.float64).tolist(), strict=True))
        fabric = self.start
        for system in SYSTEMS:
            fabric = replace(fabric, **{system: _moved(self.start.system(system), system, steps)})  # type: ignore[arg-type]
        return fabric

    def exposure(self, point: Floats) -> float:
        """What pictures are multiplied by at a point (P,)."""
        kept = (self.level / PIVOT) ** (1.0 / self.contrast_at(point) - 1.0 / self.contrast)
        return self.light * kept * math.exp(EXPOSURE_STEP * self._steps(point, EXPOSURE))

    def blur_at(self, point: Floats) -> float:
        """``Rig.blur`` at a point (P,), metres."""
        steps = self._steps(point, BLUR)
        if steps == 0.0:
            return self.blur
        unit = BLUR_UNIT * self.start.size[0]
        start = self.blur * abs(self.blur) / unit**2
        low, high = min(BLUR_RANGE[0], start), max(BLUR_RANGE[1], start)
        square = min(max(start + BLUR_STEP * steps, low), high)
        return math.copysign(unit * math.sqrt(abs(square)), square)

    def contrast_at(self, point: Floats) -> float:
        """``Rig.contrast`` at a point (P,)."""
        return Move("log", CONTRAST_STEP, *CONTRAST_RANGE).moved(self.contrast, self._steps(point, CONTRAST))

    def _steps(self, point: Floats, name: str) -> float:
        return float(point[self.names.index(name)]) if name in self.names else 0.0

    def deviations(self, point: Floats, steps: Floats) -> dict[str, float]:
        """Standard deviations ``steps`` (P,) at a point in the parameters' own units, by name; the camera's not."""
        fabric = self.fabric(point)
        result = {}
        for name, deviation in zip(self.names, steps, strict=True):
            if name in OF_THE_CAMERA:
                continue
            system, field, *channel = name.split(".")
            value = getattr(fabric.system(system), field)  # type: ignore[arg-type]
            if channel:
                value = value[CHANNELS.index(channel[0])]
            key = f"{system}.{field}" + (f"[{channel[0]}]" if channel else "")
            result[key] = MOVES[field].deviation(float(value), float(deviation))
        return result


def level_of(target: Target) -> float:
    """Mean light of a photo, see ``MatchSpace``."""
    return max(float(target.mean_color.float().mean()), LEAST_LEVEL)


def _moved(yarn: YarnParameters, system: System, steps: dict[str, float]) -> YarnParameters:
    changes: dict[str, Any] = {}
    for name, move in MOVES.items():
        if name == "albedo":
            by_channel = [steps.get(f"{system}.albedo.{c}", 0.0) for c in CHANNELS]
            changes["albedo"] = _dyed(move, yarn.albedo, by_channel)
            changes["yarn_albedo"] = tuple(_dyed(move, color, by_channel) for color in yarn.yarn_albedo)
        else:
            value = move.moved(float(getattr(yarn, name)), steps.get(f"{system}.{name}", 0.0))
            changes[name] = round(value) if name == "fiber_count" else value
    return replace(yarn, **changes)


def _dyed(move: Move, color: Color, steps: list[float]) -> Color:
    red, green, blue = (move.moved(c, s) for c, s in zip(color, steps, strict=True))
    return red, green, blue
