"""A woven material as a surface: what Chen et al. 2024 draw from their Table 2, without albedo."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import Weave

TWIST_RANGE = (-1.3, 1.3)
INCLINATION_RANGE = (0.0, 1.4)
ROUGHNESS_RANGE = (0.02, 1.0)
HEIGHT_SCALE_RANGE = (0.0, 4.0)
GAP_RANGE = (0.05, 0.9)
"""At a gap of 0 the yarn's sides would stand upright, where the maps' normal has no projected area."""

PAPER_GAP = 0.2
"""Chen et al. 2024, 5.1: "the gap takes up 20 % of the yarn"."""


@dataclass(frozen=True, eq=False)
class SurfaceMaterial:
    """Everything of a woven surface but its albedo.

    Parameters
    ----------
    weave: (rows, cols) bool
        True where the warp is on top. Row 0 is the lowest pick, column 0 the leftmost end, as in ``Weave``.
    twist: (warp, weft) radians
        psi: by how much the fibers lean out of the yarn's direction. Range: [-1.3, 1.3].
    inclination: (warp, weft) radians
        u_max: slope of the yarn's surface at the ends of a segment. Range: [0, 1.4].
    roughness: float
        alpha of the microflakes. Range: [0.02, 1].
    height_scale: float
        beta: multiplies slopes and heights. Range: [0, 4]; 0 is flat.
    gap: float
        Share of each cell's width that the yarn leaves open. Range: [0.05, 0.9].
    name:
        Of the weave, for people.

    Raises
    ------
    UsdfabError
        For numbers out of range, and a weave with a yarn that never interlaces.
    """

    weave: NDArray[np.bool_]
    twist: tuple[float, float] = (0.0, 0.0)
    inclination: tuple[float, float] = (math.radians(30), math.radians(30))
    roughness: float = 0.3
    height_scale: float = 1.0
    gap: float = PAPER_GAP
    name: str = "custom"

    def __post_init__(self) -> None:
        # The checks of a weave are those of Weave; 1 is the weft on top there.
        matrix = Weave(1 - np.asarray(self.weave, dtype=np.uint8), self.name).matrix
        warp_on_top = matrix == 0
        warp_on_top.setflags(write=False)
        object.__setattr__(self, "weave", warp_on_top)
        for name, limits in (("twist", TWIST_RANGE), ("inclination", INCLINATION_RANGE)):
            object.__setattr__(self, name, _pair(getattr(self, name), name, limits))
        for name, limits in (
            ("roughness", ROUGHNESS_RANGE), ("height_scale", HEIGHT_SCALE_RANGE), ("gap", GAP_RANGE),
        ):  # fmt: skip
            object.__setattr__(self, name, _checked(getattr(self, name), name, limits))

    @property
    def rows(self) -> int:
        """Picks (weft yarns) in one tile."""
        return int(self.weave.shape[0])

    @property
    def columns(self) -> int:
        """Ends (warp yarns) in one tile."""
        return int(self.weave.shape[1])

    @property
    def half_width(self) -> float:
        """Half the width of a yarn in cells: beyond it there is a gap."""
        return 0.5 * (1.0 - self.gap)

    def bits(self) -> str:
        """The weave as text, bottom row first, 1 where the warp is on top: ``"01/10"``."""
        return "/".join("".join("1" if v else "0" for v in row) for row in self.weave)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SurfaceMaterial) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[object, ...]:
        numbers = (self.twist, self.inclination, self.roughness, self.height_scale, self.gap)
        return (self.bits(), *numbers, self.name)


def weave_of(weave: Weave) -> NDArray[np.bool_]:
    """The ``weave`` field of a material from a ``Weave``."""
    return weave.matrix == 0


def weave_from_bits(text: str) -> NDArray[np.bool_]:
    """The inverse of ``SurfaceMaterial.bits``; ``UsdfabError`` for other text."""
    return Weave.from_rows(text).matrix == 1


def _pair(value: ArrayLike, name: str, limits: tuple[float, float]) -> tuple[float, float]:
    numbers = np.asarray(value, dtype=np.float64)
    if numbers.shape != (2,):
        raise UsdfabError("expected two numbers, warp and weft", place=name)
    return _checked(numbers[0], name, limits), _checked(numbers[1], name, limits)


def _checked(value: float, name: str, limits: tuple[float, float]) -> float:
    number = float(value)
    if not limits[0] <= number <= limits[1]:
        raise UsdfabError(f"{number:g} is not between {limits[0]:g} and {limits[1]:g}", place=name)
    return number
