"""Translation lattices of weaves, and the search over irregular repeats.

A weave is invariant under (0 rows, ``width`` columns) and (``height`` rows, ``step`` columns): a lattice with
``width * height`` different crossings. Twills and satins have height 1 and a step; so a satin with 8 x 8 cells has
8 free bits, not 64.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import gcd

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Lattice:
    """Translations that leave a weave unchanged: (0, ``width``) and (``height``, ``step``) in (rows, columns)."""

    width: int
    height: int
    step: int

    @property
    def bits(self) -> int:
        """Number of different crossings."""
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the rectangular repeat."""
        turns = self.width // gcd(self.width, self.step) if self.step else 1
        return self.height * turns, self.width

    def classes(self, rows: int, cols: int) -> NDArray[np.intp]:
        """(rows, cols) index of the equivalence class of each crossing."""
        i, j = np.mgrid[0:rows, 0:cols]
        return (i % self.height) * self.width + (j - (i // self.height) * self.step) % self.width

    def matrix(self, table: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """One rectangular repeat of the class values ``table`` (bits,)."""
        return np.asarray(table)[self.classes(*self.shape)].astype(np.uint8)


@lru_cache(maxsize=4)
def all_lattices(max_side: int = 8, max_bits: int = 64) -> tuple[Lattice, ...]:
    """All lattices of height above 1 whose rectangular repeat has sides up to ``max_side``."""
    out = []
    for width in range(2, max_side + 1):
        for height in range(2, max_side + 1):
            if width * height <= max_bits:
                steps = (Lattice(width, height, s) for s in range(width))
                out += [lattice for lattice in steps if lattice.shape[0] <= max_side]
    return tuple(out)


def interlaces(matrix: NDArray[np.uint8]) -> bool:
    """Whether every pick and every end is once on top and once below."""
    return not any((matrix.all(axis) | ~matrix.any(axis)).any() for axis in (0, 1))
