"""The tile that stands for a whole cloth: how many repeats of the weave it holds, and which variant stands where.

Whoever draws cloth must choose the same, so that pictures made in different ways agree fiber by fiber.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.fabric import FabricParameters

TILE_CELLS = 4
"""A tile has at least this many cells on each side: rays cross its border less often, and repetition shows less."""

MAX_TILE_SEGMENTS = 1_500_000
"""Beyond this a tile stays at one repeat of the weave."""


def tile_copies(fabric: FabricParameters) -> tuple[int, int]:
    """Repeats of the weave along x and y that make up one tile."""
    picks, ends = fabric.repeat()
    copies = max(1, -(-TILE_CELLS // ends)), max(1, -(-TILE_CELLS // picks))
    segments = sum(
        copies[0] * copies[1] * fabric.system(s).fiber_count * 40 * 2 * (ends if s == "warp" else picks)
        for s in ("warp", "weft")
    )
    return copies if segments <= MAX_TILE_SEGMENTS else (1, 1)


def tile_variants(column: ArrayLike, row: ArrayLike, count: int) -> NDArray[np.int64]:
    """Which of ``count`` variants stands at tiles (column, row), by a hash.

    The same numbers as the tracer's compiled ``variant_at``: tile (i, j) covers the cloth from (i, j) to
    (i + 1, j + 1) times the tile's size.
    """
    i, j = (np.asarray(a, dtype=np.int64) & 0xFFFFFFFF for a in (column, row))
    key = i.astype(np.uint64) | (j.astype(np.uint64) << np.uint64(32))
    return (_mix(_mix(key)) % np.uint64(max(count, 1))).astype(np.int64)


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The 64-bit finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    with np.errstate(over="ignore"):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
