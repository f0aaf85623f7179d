"""Where pieces of tiles go on a surface: whole tiles where it is flat, smaller pieces where it bends or ends.

A tile is divided (``divide``) until its pieces lie on the surface as closely as wanted. Tiles that the cloth's border,
a seam or the region's edge cuts are divided to the end; of their pieces those stay whose centre lies on the cloth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.expand.centres import centres_inside
from usdfab.usd.expand.divide import Tiling
from usdfab.usd.expand.frames import Frames, corner_frames, poses, regular
from usdfab.usd.expand.surface import ClothSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Box = tuple[float, float, float, float]
Tint = Callable[[Floats, Floats], Floats]
"""Factors of the albedo (N, 3) from texture coordinates (N, 2) and the mesh's colours (N, 3)."""

MAX_TINT_CHANGE = 0.04
"""A piece has one colour: one whose corners differ more than this is divided."""

_MAX_SAMPLES = 20_000_000
_BETWEEN = 1e-5
"""Borders this near to the line between two cells, in cells, run between them."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of tiles on a surface, N of them.

    ``chart`` (N,); ``tile`` (N, 2) column and row; ``level`` (N,) and ``part`` (N, 2) which piece of the tile;
    ``first``, ``last`` (N, 2) the cells of the weave that it covers, counted over the whole cloth; ``frames``;
    ``tint`` (N, 3).
    """

    chart: Ints
    tile: Ints
    level: Ints
    part: Ints
    first: Ints
    last: Ints
    frames: Frames
    tint: Floats

    def __len__(self) -> int:
        return len(self.chart)

    @staticmethod
    def joined(parts: list[Pieces]) -> Pieces:
        """The pieces of several, at least one."""
        names = ("chart", "tile", "level", "part", "first", "last", "tint")
        arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        centers, linear = (np.concatenate([getattr(p.frames, name) for p in parts]) for name in ("centers", "linear"))
        return Pieces(frames=Frames(centers, linear), **arrays)


def place_pieces(
    surface: ClothSurface,
    tiling: Tiling,
    tolerance: float,
    thickness: float,
    tint: Tint,
    region: Box | None = None,
    *,
    shear_steps: Floats | None = None,
    limit: Callable[[int], None] = lambda count: None,
) -> Pieces:
    """Put a tile's pieces on a surface.

    Parameters
    ----------
    tolerance: metres
        How far a piece may be from the surface at its corners.
    thickness: metres
        Of the cloth: at half of it above and below, pieces that lean against each other may open as much.
    region:
        (x0, y0, x1, y1) metres of cloth: only pieces whose centre lies there.
    shear_steps: (levels,) tangents
        How finely the prototypes of each level are sheared (``poses``); None: frames are used as they are.
    limit:
        Called with the number of pieces so far; raises where they are too many.
    """
    border = border_cells(surface, tiling)
    current = candidates(surface, tiling, border, region)
    part = np.zeros((len(current), 2), dtype=np.int64)
    found: list[Pieces] = []
    count = 0
    for number, level in enumerate(tiling.levels):
        last_level = number == len(tiling.levels) - 1
        chart, tile = current[:, 0], current[:, 1:]
        first = tile * tiling.cells + np.stack([level.x[part[:, 0]], level.y[part[:, 1]]], axis=1)
        last = tile * tiling.cells + np.stack([level.x[part[:, 0] + 1], level.y[part[:, 1] + 1]], axis=1)
        low, high = (np.asarray(c * np.asarray(tiling.cell), dtype=np.float64) for c in (first, last))
        cut = _holds(border, chart, tile, part, level.x, level.y, tiling.cells)
        middle = 0.5 * (low + high)
        wanted = np.ones(len(low), dtype=bool)
        if region is not None:
            wanted = np.all((middle >= region[:2]) & (middle < region[2:]), axis=1)
            apart = (low >= region[2:]).any(axis=1) | (high <= region[:2]).any(axis=1)
            cut |= ~(apart | ((low >= region[:2]) & (high <= region[2:])).all(axis=1))
        triangle, weights = surface.locate(chart, middle)
        on = triangle >= 0
        split = cut if not last_level else np.zeros(len(cut), dtype=bool)
        here = np.flatnonzero(on & wanted & ~split)
        center = surface.at(triangle[here], weights[here])
        frames, corners, there = corner_frames(surface, chart[here], triangle[here], center, low[here], high[here])
        colors = tint(center.uv, center.tint)
        good = regular(frames)
        if not last_level:
            used = frames
            if shear_steps is not None:
                used = Frames(frames.centers, poses(frames, np.full(len(here), shear_steps[number])).linear)
            error = _error(used, corners, there.normals, center.points, (high - low)[here], thickness)
            around = tint(there.uv, there.tint).reshape(-1, 4, 3)
            change = np.abs(around - colors[:, None]).max(axis=(1, 2))
            divided = good & ((error > tolerance) | (change > MAX_TINT_CHANGE))
            good &= ~divided
            split[here[divided]] = True
        keep = here[good]
        count += len(keep)
        limit(count + int(split.sum()))
        found.append(
            Pieces(
                chart[keep], tile[keep], np.full(len(keep), number), part[keep], first[keep], last[keep],
                frames[good], colors[good],
            )
        )  # fmt: skip
        if last_level:
            break
        current, part = _children(current[split], part[split], level.child_x, level.child_y)
    return Pieces.joined(found)


def _error(frames: Frames, corners: Floats, normals: Floats, center: Floats, size: Floats, thickness: float) -> Floats:
    """(N,) metres: how far frames are from the surface.

    At the corners; at the centre, where a quarter counts (nothing opens there); and by how much the cloth's faces open
    at the corners because normals turn, where a fifth counts: fibers overlap there.
    """
    signs = np.array([(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, 0.5, 0.0), (0.5, 0.5, 0.0)])
    local = signs[None] * np.concatenate([size, np.zeros((len(size), 1))], axis=1)[:, None]
    at_corners = np.linalg.norm(frames.at(local) - corners, axis=2).max(axis=1, initial=0.0)
    at_center = np.linalg.norm(frames.centers - center, axis=1)
    up = frames.linear[:, :, 2]
    up = up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-300)
    turn = np.linalg.norm(normals.reshape(-1, 4, 3) - up[:, None], axis=2).max(axis=1, initial=0.0)
    return np.maximum(at_corners, np.maximum(0.25 * at_center, 0.1 * thickness * turn))


# --- which tiles -----------------------------------------------------------------------------------------------------


def border_cells(surface: ClothSurface, tiling: Tiling) -> Ints:
    """(M, 5) where borders of the cloth run: chart, and column and row of the cells of the weave on both sides.

    These are the same unless a border runs exactly between them.
    """
    triangle, edge = surface.border
    start, end = surface.xy[triangle, edge], surface.xy[triangle, (edge + 1) % 3]
    cell = np.asarray(tiling.cell)
    steps = np.ceil(3.0 * (np.abs(end - start) / cell).max(axis=1, initial=0.0)).astype(np.int64) + 1
    if steps.sum() > _MAX_SAMPLES:
        steps = np.maximum(steps * _MAX_SAMPLES // steps.sum(), 1)
    owner = np.repeat(np.arange(len(start)), steps)
    share = (np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[owner]
    place = (start[owner] + share[:, None] * (end - start)[owner]) / cell
    # A border that runs exactly between cells cuts neither, but a piece that holds both.
    first, last = np.floor(place - _BETWEEN).astype(np.int64), np.floor(place + _BETWEEN).astype(np.int64)
    return np.unique(np.column_stack([surface.chart[triangle[owner]], first, last]), axis=0)


def candidates(surface: ClothSurface, tiling: Tiling, border: Ints, region: Box | None) -> Ints:
    """(N, 3) chart, column and row of all tiles that may lie on the surface."""
    size = np.asarray(tiling.size)
    triangle, index = centres_inside(surface.xy, size)
    tiles = np.column_stack([surface.chart[triangle], index])
    first, last = border[:, 1:3] // np.asarray(tiling.cells), border[:, 3:] // np.asarray(tiling.cells)
    cut = np.column_stack([border[:, 0], first])[(first == last).all(axis=1)]
    if region is not None:
        lowest, highest = np.floor(np.array(region[:2]) / size), np.floor(np.array(region[2:]) / size)
        tiles, cut = (t[((t[:, 1:] >= lowest) & (t[:, 1:] <= highest)).all(axis=1)] for t in (tiles, cut))
    return np.unique(np.concatenate([tiles, cut]), axis=0)


def _holds(
    border: Ints, chart: Ints, tile: Ints, part: Ints, x: Ints, y: Ints, cells: tuple[int, int]
) -> NDArray[np.bool_]:
    """Whether a border runs through each piece."""
    if len(border) == 0:
        return np.zeros(len(chart), dtype=bool)
    sides = []
    for cell in (border[:, 1:3], border[:, 3:]):
        own, local = np.divmod(cell, np.asarray(cells))
        i, j = np.searchsorted(x, local[:, 0], "right") - 1, np.searchsorted(y, local[:, 1], "right") - 1
        sides.append(np.column_stack([border[:, 0], own, i, j]))
    cut = np.unique(sides[0][(sides[0] == sides[1]).all(axis=1)], axis=0)
    both = np.concatenate([cut, np.column_stack([chart, tile, part])])
    number = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    return np.isin(number[len(cut) :], number[: len(cut)])


def _children(parents: Ints, part: Ints, child_x: Ints, child_y: Ints) -> tuple[Ints, Ints]:
    """(parents repeated, parts at the next level)."""
    x, y = child_x[part[:, 0]], child_y[part[:, 1]]
    columns = x[:, 1] - x[:, 0]
    number = columns * (y[:, 1] - y[:, 0])
    owner = np.repeat(np.arange(len(parents)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    parts = np.stack([x[owner, 0] + within % columns[owner], y[owner, 0] + within // columns[owner]], axis=1)
    return parents[owner], parts
