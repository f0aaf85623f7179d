"""The drawdown of a fabric as a picture: each crossing in the colour of the yarn on top, the loom's plans around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.draft import Loom, loom_of
from usdfab.fabric.fabric import FabricParameters

MAX_PIXELS = 16384
"""Longest side of a picture."""

GAP = 1
"""Empty cells between the drawdown, the plans and the colour bars."""

PAPER, INK, RULE = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.6, 0.6, 0.6)


def crossing_colors(fabric: FabricParameters, copies: tuple[int, int] = (1, 1)) -> NDArray[np.float64]:
    """(picks, ends, 3) linear colour of the yarn on top at each crossing of so many repeats (x, y); row 0 is pick 1."""
    picks, ends = fabric.repeat()
    picks, ends = picks * copies[1], ends * copies[0]
    matrix = np.tile(fabric.weave.matrix, (picks // fabric.weave.picks, ends // fabric.weave.ends))
    weft, warp = (np.asarray(fabric.system(s).colors()) for s in ("weft", "warp"))
    rows, columns = weft[np.arange(picks) % len(weft)], warp[np.arange(ends) % len(warp)]
    return np.where(matrix[..., None] == 1, rows[:, None], columns[None, :])


def draft_picture(fabric: FabricParameters, cell: int = 12, fewest: int = 16) -> NDArray[np.float32]:
    """(H, W, 3) linear: the drawdown, the threading above it, the treadling to its right, the tie-up in the corner.

    End 1 is at the left, pick 1 at the bottom; bars along the plans show the yarns' colours. Small repeats are shown
    several times.

    Parameters
    ----------
    cell: pixels
        Side of a crossing.
    fewest:
        Ends and picks that are shown, at least.

    Raises
    ------
    UsdfabError
        If the picture would be larger than ``MAX_PIXELS``.
    """
    picks, ends = fabric.repeat()
    copies = -(-fewest // ends), -(-fewest // picks)
    colors = crossing_colors(fabric, copies)
    loom = loom_of(np.tile(fabric.weave.matrix, (picks // fabric.weave.picks, ends // fabric.weave.ends)))
    tops = _plans(fabric, loom, colors.shape[0], colors.shape[1])
    if max(tops.shape[:2]) * cell > MAX_PIXELS:
        raise UsdfabError(
            f"the draft of {picks} picks and {ends} ends is too large for a picture", place="--screenshot"
        )
    tops[-colors.shape[0] :, : colors.shape[1]] = colors[::-1]
    picture = np.repeat(np.repeat(tops, cell, axis=0), cell, axis=1)
    if cell >= 6:
        inked = np.repeat(np.repeat(np.isfinite(tops[..., 0]), cell, axis=0), cell, axis=1)
        lines = (np.arange(picture.shape[0]) % cell == 0)[:, None] | (np.arange(picture.shape[1]) % cell == 0)[None]
        picture[lines & inked] = RULE
    return np.where(np.isnan(picture), 1.0, picture).astype(np.float32)


def _plans(fabric: FabricParameters, loom: Loom, picks: int, ends: int) -> NDArray[np.float64]:
    """(rows, columns, 3) one cell for each crossing and mark, NaN on bare paper; the drawdown is left empty."""
    warp, weft = (np.asarray(fabric.system(s).colors()) for s in ("warp", "weft"))
    threading = loom.threading[np.arange(ends) % len(loom.threading)]
    treadling = loom.treadling[np.arange(picks) % len(loom.treadling)]
    top, right = loom.shafts + 2 * GAP + 1, loom.treadles + 2 * GAP + 1
    sheet = np.full((top + picks, ends + right, 3), np.nan)
    # Shaft 1 is the lowest row of the threading, treadle 1 the leftmost column of the treadling.
    shafts_up = np.arange(loom.shafts)[::-1]
    above, beside = slice(GAP + 1, GAP + 1 + loom.shafts), slice(ends + GAP, ends + GAP + loom.treadles)
    sheet[0, :ends] = warp[np.arange(ends) % len(warp)]
    sheet[top:, -1] = weft[np.arange(picks) % len(weft)][::-1]
    sheet[above, :ends] = _marks(threading[None, :] == shafts_up[:, None])
    sheet[above, beside] = _marks(loom.tieup.T[::-1])
    sheet[top:, beside] = _marks((treadling[:, None] == np.arange(loom.treadles))[::-1])
    return sheet


def _marks(filled: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(filled[..., None], INK, PAPER)
