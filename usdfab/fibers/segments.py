"""From a weave matrix to stations: the places along each yarn at which its fibers get vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import System, Weave

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Layout:
    """The stations of one yarn system over one patch, all yarns one after the other.

    Lengths are in cells along the yarn. Arrays have shape ``(stations,)`` unless said otherwise.
    """

    system: System
    yarns: int
    length: int
    """Cells along each yarn in one patch: the period of the curves."""
    first: Ints
    """(yarns + 1,) index of each yarn's first station, and the number of stations at the end."""
    yarn: Ints
    """Which yarn the station belongs to."""
    position: Floats
    """Place along the yarn in [0, length), increasing within each yarn."""
    y: Floats
    """Place within the segment, in [0, segment_length)."""
    segment_length: Floats
    side: Floats
    """+1 on the face of the cloth, -1 on its back."""
    segment: Ints
    """Index of the segment within the yarn."""


def lay_out(weave: Weave, system: System, vertices_per_segment: int) -> Layout:
    """Stations of all yarns of a system: ``vertices_per_segment`` equal steps in each segment.

    A *segment* is a run of cells in which the yarn stays on one side; it starts and ends on cell borders, where the
    centre line crosses z = 0 (Li et al. 2024, section 4.2).
    """
    # One row per yarn, 1 where this system is on the face.
    face = weave.matrix if system == "weft" else 1 - weave.matrix.T
    yarns, length = face.shape
    step = np.arange(vertices_per_segment) / vertices_per_segment
    columns: list[list[np.ndarray]] = []
    counts = []
    for yarn in range(yarns):
        starts = np.flatnonzero(face[yarn] != np.roll(face[yarn], 1))
        lengths = np.diff(np.r_[starts, starts[0] + length])
        segments = np.arange(len(starts))
        y = (lengths[:, None] * step).ravel()
        position = np.mod((starts[:, None] + lengths[:, None] * step).ravel(), length)
        repeat = vertices_per_segment
        sides = np.where(face[yarn, starts] == 1, 1.0, -1.0)
        # The segment that runs over the patch border is split, so that every curve starts at the border.
        order = np.argsort(position, kind="stable")
        columns.append(
            [
                np.full(len(order), yarn),
                position[order],
                y[order],
                np.repeat(lengths, repeat)[order].astype(float),
                np.repeat(sides, repeat)[order],
                np.repeat(segments, repeat)[order],
            ]
        )
        counts.append(len(order))
    yarn_of, position, y, segment_length, side, segment = (np.concatenate(c) for c in zip(*columns, strict=True))
    first = np.r_[0, np.cumsum(counts)]
    return Layout(system, yarns, length, first, yarn_of, position, y, segment_length, side, segment)
