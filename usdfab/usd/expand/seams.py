"""How well neighbouring pieces meet: the distance between the ends of yarns on both sides of each border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.usd.expand.divide import Tiling
from usdfab.usd.expand.frames import Frames
from usdfab.usd.expand.place import Pieces

Floats = NDArray[np.float64]

_MOST = 400_000
"""Borders that are measured at most; of more, every so many."""


@dataclass(frozen=True)
class Seams:
    """Distances in metres between fibers that should be one, where pieces meet inside the cloth.

    ``median``, ``p99`` and ``largest`` are those in the cloth's mid-surface; ``face_p99`` and ``face_largest`` those at
    the outside of the yarns, where pieces of bent cloth open and overlapping ends close the gap. ``fiber_radius`` and
    ``yarn_width`` are for comparison. ``count``: how many ends were measured. ``place``: where the
    largest is, metres; ``normal``: where the cloth's front looks there.
    """

    median: float
    p99: float
    largest: float
    face_p99: float
    face_largest: float
    fiber_radius: float
    yarn_width: float
    count: int
    place: tuple[float, float, float]
    normal: tuple[float, float, float]


def measure_seams(pieces: Pieces, frames: Frames, tiling: Tiling, fabric: FabricParameters) -> Seams | None:
    """The seams between pieces as placed by ``frames``; None where no two pieces meet.

    At each place where a yarn crosses the border between two pieces (the middle of a cell's side), its axis and the
    points a yarn radius above and below are put into the world by both.
    """
    cell = np.asarray(tiling.cell)
    keys, number, local = [], [], []
    for axis in (0, 1):
        other = 1 - axis
        count = (pieces.last - pieces.first)[:, other]
        owner = np.repeat(np.arange(len(pieces)), count)
        along = pieces.first[owner, other] + np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        for border in (pieces.first, pieces.last):
            key = np.empty((len(owner), 4), dtype=np.int64)
            key[:, 0], key[:, 1] = pieces.chart[owner], axis
            key[:, 2 + axis], key[:, 2 + other] = border[owner, axis], along
            place = np.zeros((len(owner), 3))
            middle = 0.5 * (pieces.first + pieces.last)[owner]
            place[:, axis] = (border[owner, axis] - middle[:, axis]) * cell[axis]
            place[:, other] = (along + 0.5 - middle[:, other]) * cell[other]
            keys.append(key)
            number.append(owner)
            local.append(place)
    key, owner, place = np.concatenate(keys), np.concatenate(number), np.concatenate(local)
    order = np.lexsort(key.T)
    same = np.flatnonzero((key[order[1:]] == key[order[:-1]]).all(axis=1))
    if len(same) == 0:
        return None
    same = same[:: -(-len(same) // _MOST)]
    one, two = order[same], order[same + 1]
    radius = {0: fabric.weft.radius, 1: fabric.warp.radius}
    height = np.where(key[one, 1] == 0, radius[0], radius[1])
    gaps, middle = [], np.zeros((len(one), 3))
    for side in (0.0, 1.0, -1.0):
        up = np.array([0.0, 0.0, 1.0]) * (side * height)[:, None]
        ends = [frames[owner[k]].at(place[k] + up) for k in (one, two)]
        middle = ends[0] if side == 0.0 else middle
        gaps.append(np.linalg.norm(ends[0] - ends[1], axis=1))
    faces = np.maximum(gaps[1], gaps[2])
    width = 2.0 * min(y.radius * y.flattening for y in (fabric.warp, fabric.weft))
    fiber = min(y.effective_fiber_radius for y in (fabric.warp, fabric.weft))
    worst = int(faces.argmax())
    x, y, z = map(float, middle[worst])
    up = frames.linear[owner[one[worst]], :, 2]
    a, b, c = map(float, up / np.linalg.norm(up))
    gap, face_gap = np.percentile(gaps[0], [50, 99, 100]), np.percentile(faces, [99, 100])
    return Seams(
        median=float(gap[0]), p99=float(gap[1]), largest=float(gap[2]),
        face_p99=float(face_gap[0]), face_largest=float(face_gap[1]),
        fiber_radius=fiber, yarn_width=width, count=len(one), place=(x, y, z), normal=(a, b, c),
    )  # fmt: skip
