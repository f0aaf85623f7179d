"""Which pixels get how many samples: tiles, passes over the picture, and when a tile is good enough.

Everything here is arithmetic on the sums gathered so far. No decision depends on the clock, on threads or on the order
in which tiles are done, so a picture that is rendered whole, in parts, in pieces or with interruptions is the same.

Adaptive sampling. At sample counts 16, 32, 64, ... each tile asks whether its own estimated error is below the wanted
one, and the first count at which it says yes is its *stop*. A tile's pixels get as many samples as the largest stop
among the tile and its eight neighbours. A tile that happens to look clean, because it has not yet met the bright paths
that its neighbours know of, thus goes on with them; few looks, at powers of two, keep the bias of stopping small.
Stops depend on a tile's own samples alone, so what a tile needs to know of the world ends at its neighbours: a region
is rendered with one ring of further tiles (``Tile.wanted`` False) and then equals the whole picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.imaging.metrics import RELATIVE_FLOOR
from usdfab.tracer.film import CHANNELS, SAMPLES

Window = tuple[int, int, int, int]
"""(x0, y0, x1, y1) in pixels of the whole picture, upper ends excluded."""

LAYERS = CHANNELS + 3
"""Numbers kept for a pixel: the film's channels, then the sums of the squares of RGB."""
PASS_SAMPLES = 16
"""Most samples of a tile in one go, so that interrupts and time limits are heeded soon."""
FIRST_DECISION = 16
"""Samples before adaptive sampling asks for the first time."""
BLOCK = 8
"""Side in pixels of the blocks over which ``relative_error`` averages."""
LARGE_PICTURE = 512 * 512
SMALL_REGION = 128 * 128
"""Pixels below which a region has small tiles, where no tile decides for itself."""


@dataclass(frozen=True)
class Tile:
    """A rectangle of pixels that is rendered in one go; ``row`` and ``column`` in the grid of the whole picture."""

    row: int
    column: int
    window: Window
    wanted: bool = True


def tile_side(width: int, height: int) -> int:
    """Side of the tiles of a picture, from its size alone: small pictures have small ones, for many threads."""
    return 32 if width * height >= LARGE_PICTURE else 16


def plan_tiles(
    width: int, height: int, region: Window, part: tuple[int, int] = (1, 1), adaptive: bool = False
) -> list[Tile]:
    """The tiles of part i of n of a region, rows from the top; parts are runs of tiles.

    With ``adaptive`` tiles are whole even where the region cuts them, and the tiles beside the wanted ones come along.
    """
    side = tile_side(width, height)
    x0, y0, x1, y1 = region
    if not adaptive and (x1 - x0) * (y1 - y0) < SMALL_REGION:
        side = 8  # enough tiles for all threads; where each tile decides how good it is, tiles must not depend on it

    def window(row: int, column: int, crop: bool) -> Window:
        a, b = column * side, row * side
        c, d = min(a + side, width), min(b + side, height)
        return (max(a, x0), max(b, y0), min(c, x1), min(d, y1)) if crop else (a, b, c, d)

    places = [(r, c) for r in range(y0 // side, -(-y1 // side)) for c in range(x0 // side, -(-x1 // side))]
    i, n = part
    places = places[(i - 1) * len(places) // n : i * len(places) // n]
    if not adaptive:
        return [Tile(r, c, window(r, c, True)) for r, c in places]
    wanted = set(places)
    rows, columns = -(-height // side), -(-width // side)
    around = {(r + dr, c + dc) for r, c in places for dr in (-1, 0, 1) for dc in (-1, 0, 1)}
    inside = sorted((r, c) for r, c in around if 0 <= r < rows and 0 <= c < columns)
    return [Tile(r, c, window(r, c, False), (r, c) in wanted) for r, c in inside]


def bounds(tiles: Sequence[Tile]) -> Window:
    """The smallest window around the tiles; of no size without any."""
    if not tiles:
        return 0, 0, 0, 0
    w = np.array([tile.window for tile in tiles])
    return int(w[:, 0].min()), int(w[:, 1].min()), int(w[:, 2].max()), int(w[:, 3].max())


class Work:
    """Sums of the samples taken so far, and the tiles they belong to.

    Attributes
    ----------
    tiles:
        What is to be rendered.
    window:
        Pixels that ``sums`` covers.
    sums: (H, W, LAYERS)
        The one record of what is done: how many samples a tile has is read from its SAMPLES channel.
    stops: (T,) int64
        Sample counts at which tiles were found good enough; 0: not yet.
    """

    def __init__(
        self, tiles: Sequence[Tile], sums: NDArray[np.float64] | None = None, stops: NDArray[np.int64] | None = None
    ) -> None:
        self.tiles = tuple(tiles)
        self.window = bounds(tiles)
        x0, y0, x1, y1 = self.window
        self.sums = np.zeros((y1 - y0, x1 - x0, LAYERS)) if sums is None else sums
        self.stops = np.zeros(len(tiles), dtype=np.int64) if stops is None else stops
        index = {(tile.row, tile.column): k for k, tile in enumerate(tiles)}
        self._around = [
            [k for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (k := index.get((t.row + dr, t.column + dc))) is not None]
            for t in tiles
        ]
        self._corners = np.array([t.window[:2] for t in tiles], dtype=np.int64).reshape(-1, 2) - [x0, y0]

    def part(self, window: Window) -> NDArray[np.float64]:
        """A view of the sums of a window."""
        x0, y0, x1, y1 = window
        return self.sums[y0 - self.window[1] : y1 - self.window[1], x0 - self.window[0] : x1 - self.window[0]]

    def counts(self) -> NDArray[np.int64]:
        """(T,) samples per pixel that each tile has."""
        return self.sums[self._corners[:, 1], self._corners[:, 0], SAMPLES].astype(np.int64)

    def limits(self, spp: int) -> NDArray[np.int64]:
        """(T,) samples per pixel that each tile is to have as far as is known now, at most ``spp``."""
        own = np.where(self.stops > 0, self.stops, spp)
        limits = [max(own[self._around[k]]) if tile.wanted else own[k] for k, tile in enumerate(self.tiles)]
        return np.minimum(np.array(limits, dtype=np.int64), spp)

    def settle(self, noise: float, gain: float) -> None:
        """Let the tiles that are at a power of two of samples decide whether they are good enough."""
        counts = self.counts()
        for k, tile in enumerate(self.tiles):
            n = int(counts[k])
            due = self.stops[k] == 0 and n >= FIRST_DECISION and n & (n - 1) == 0
            if due and relative_error(self.part(tile.window), gain) <= noise:
                self.stops[k] = n

    def keep_wanted(self) -> None:
        """Forget the samples of tiles that were only looked at for their neighbours' sake."""
        for tile in self.tiles:
            if not tile.wanted:
                self.part(tile.window)[...] = 0.0


def next_count(count: int, spp: int) -> int:
    """Samples after the next pass: 1, 2, 4, 8, 16, 32, 48, 64, ..., spp.

    Passes grow, so that the first picture is there soon and the overhead of passes vanishes.
    """
    grown = 1 << count.bit_length() if count < PASS_SAMPLES else (count // PASS_SAMPLES + 1) * PASS_SAMPLES
    return min(grown, spp)


def relative_error(sums: NDArray[np.float64], gain: float = 1.0) -> float:
    """Estimated relative standard error of pixels, the root of an estimated relMSE (``imaging.relmse``).

    ``sqrt(mean over blocks of V / (L^2 + 0.01))`` with V the mean variance of the pixels' means and L the mean value in
    a block of 8 x 8 pixels, both over the three channels and after the camera's exposure. Blocks, since a single
    pixel's few samples know too little of their own variance: a pixel that saw nothing yet would call itself perfect.

    Parameters
    ----------
    sums: (h, w, LAYERS)
        At least two samples in each pixel; else the error is infinite.
    gain:
        2^exposure.
    """
    n = sums[..., SAMPLES]
    if n.size == 0 or n.min() < 2:
        return float("inf")
    mean = gain * sums[..., :3] / n[..., None]
    square = gain * gain * sums[..., CHANNELS:] / n[..., None]
    variance = np.maximum(square - mean * mean, 0.0).mean(axis=-1) / (n - 1)
    size = _block_sums(np.ones_like(variance))
    v, level = _block_sums(variance) / size, _block_sums(mean.mean(axis=-1)) / size
    relative = v / (level * level + RELATIVE_FLOOR)
    return float(np.sqrt((relative * size).sum() / size.sum()))


def _block_sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    height, width = values.shape
    return np.add.reduceat(np.add.reduceat(values, np.arange(0, height, BLOCK), 0), np.arange(0, width, BLOCK), 1)
