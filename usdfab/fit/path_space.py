"""The optics that stage 3 estimates as unconstrained coordinates: logits of where they lie in their ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.optics import ROUGHNESSES, Optics
from usdfab.fabric.parameters import PARAMETER_BY_NAME

Floats = NDArray[np.float64]

ALBEDO_RANGE = (0.002, 0.999)
"""A white fiber's picture has no derivative by its albedo coefficient, and a black one's logarithm no end."""

SPARE = 0.2
"""Part of a range's width between its end and a start that lies outside it or close to its end."""


@dataclass(frozen=True, eq=False)
class OpticsSpace:
    """Coordinates ``u``, any numbers, of those entries of ``Optics.vector`` that are estimated.

    An entry is ``low + (high - low) / (1 + exp(-u))``. Made by :meth:`around`.

    Parameters
    ----------
    start: (P,)
        All entries; those that are not estimated stay at these values.
    free: (N,) int
        Which are estimated.
    low, high: (N,)
        Their open ranges.
    names:
        Their names.
    """

    start: Floats
    free: NDArray[np.int64]
    low: Floats
    high: Floats
    names: tuple[str, ...]

    @classmethod
    def around(cls, optics: Optics) -> OpticsSpace:
        """The entries that the parameter table gives to the stage ``path``, in its soft ranges.

        Ranges are widened, within the hard ones, where the start is not well inside.
        """
        vector, names = optics.vector(), optics.names()
        parameters = [PARAMETER_BY_NAME[name.split(".")[1].split("[")[0]] for name in names]
        free = np.array([i for i, p in enumerate(parameters) if "path" in p.stages])
        low, high = np.empty(len(free)), np.empty(len(free))
        for row, i in enumerate(free):
            parameter, value = parameters[i], vector[i]
            if parameter.name not in ROUGHNESSES:
                low[row], high[row] = ALBEDO_RANGE
                continue
            spare = SPARE * (parameter.soft[1] - parameter.soft[0])
            low[row] = max(parameter.hard[0], min(parameter.soft[0], value - spare))
            high[row] = min(parameter.hard[1], max(parameter.soft[1], value + spare))
        return cls(vector, free, low, high, tuple(names[i] for i in free))

    @property
    def size(self) -> int:
        """How many entries are estimated."""
        return len(self.free)

    def coordinates(self, vector: Floats) -> Floats:
        """(N,) of a vector (P,); entries at or beyond the end of their range are taken a thousandth of it inside."""
        part = (vector[self.free] - self.low) / (self.high - self.low)
        part = np.clip(part, 1e-3, 1.0 - 1e-3)
        return np.log(part / (1.0 - part))

    def vector(self, coordinates: Floats) -> Floats:
        """(P,) of coordinates (N,)."""
        if coordinates.shape != (self.size,):
            raise UsdfabError(f"expected {self.size} coordinates, got an array of shape {coordinates.shape}")
        result = self.start.copy()
        result[self.free] = self.low + (self.high - self.low) * _logistic(coordinates)
        return result

    def slope(self, coordinates: Floats) -> Floats:
        """(N,) derivatives of the estimated entries by their coordinates."""
        part = _logistic(coordinates)
        return (self.high - self.low) * part * (1.0 - part)


def _logistic(x: Floats) -> Floats:
    return 0.5 * (1.0 + np.tanh(0.5 * x))
