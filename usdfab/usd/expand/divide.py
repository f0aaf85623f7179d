"""How a tile is divided into pieces: the whole, then halves of halves down to single cells of the weave.

A piece is as stiff as a prototype of instances has to be. Where the surface bends, smaller pieces follow it better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

MAX_PROTOTYPES = 2048
"""Levels whose pieces, times the variants, are more than this in all are not used."""


@dataclass(frozen=True, eq=False)
class Level:
    """One division of a tile.

    ``x``, ``y``: borders between pieces in cells, from 0 to the tile's cells. ``child_x``, ``child_y``: for each piece,
    the first and one past the last of its parts at the next level.
    """

    x: Ints
    y: Ints
    child_x: NDArray[np.int64]
    child_y: NDArray[np.int64]

    @property
    def pieces(self) -> int:
        """Number of pieces."""
        return (len(self.x) - 1) * (len(self.y) - 1)


@dataclass(frozen=True, eq=False)
class Tiling:
    """A fabric's tile: ``cells`` columns and rows, each ``cell`` metres, and its divisions from coarse to fine."""

    cells: tuple[int, int]
    cell: tuple[float, float]
    levels: tuple[Level, ...]

    @property
    def size(self) -> tuple[float, float]:
        """Metres."""
        return self.cells[0] * self.cell[0], self.cells[1] * self.cell[1]


def divide(cells: tuple[int, int], cell: tuple[float, float], variants: int, levels: int | None = None) -> Tiling:
    """The divisions of a tile; at most ``levels`` of them, and no more than ``MAX_PROTOTYPES`` allows."""
    found: list[Level] = []
    x, y = np.array([0, cells[0]]), np.array([0, cells[1]])
    total = 0
    while True:
        next_x, child_x = _halved(x)
        next_y, child_y = _halved(y)
        level = Level(x, y, child_x, child_y)
        total += variants * level.pieces
        if found and (total > MAX_PROTOTYPES or (levels is not None and len(found) >= levels)):
            break
        found.append(level)
        if len(next_x) == len(x) and len(next_y) == len(y):
            break
        x, y = next_x, next_y
    return Tiling(cells, cell, tuple(found))


def _halved(borders: Ints) -> tuple[Ints, NDArray[np.int64]]:
    """Borders with every interval of two cells or more in two, and (n, 2) the parts of each interval."""
    middle = (borders[:-1] + borders[1:] + 1) // 2
    splits = np.diff(borders) > 1
    first = np.r_[0, np.cumsum(1 + splits)]
    return np.union1d(borders, middle[splits]), np.stack([first[:-1], first[1:]], axis=1)
