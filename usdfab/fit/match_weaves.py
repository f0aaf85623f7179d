"""Weaves that a photo may show where another was read: the same repeat with longer or shorter floats, or broken.

Crossings are hard to read where thick yarns cover thin ones: a thin warp that comes up once in four looks as wide as
one that comes up twice. A picture of either tells them apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import Weave

BROKEN = (0, 2, 1, 3)
"""Shifts of the picks of a broken twill, the satin of four ends."""


def pick_shifts(weave: Weave) -> tuple[int, ...] | None:
    """By how many ends each pick is shifted against the first, if all are alike; None for other weaves."""
    rows = weave.matrix
    turned = np.stack([np.roll(rows[0], k) for k in range(rows.shape[1])])
    shifts = []
    for row in rows:
        found = np.flatnonzero((turned == row).all(axis=1))
        if not len(found):
            return None
        shifts.append(int(found[0]))
    return tuple(shifts)


def with_floats(weave: Weave, over: int) -> Weave | None:
    """The weave whose picks lie over ``over`` ends in a row, shifted as before; a negative number: under so many.

    None where picks are not alike, have fewer than three ends, or no such weave is cloth.
    """
    shifts, ends = pick_shifts(weave), weave.ends
    length = over % ends
    if shifts is None or ends < 3 or length == 0 or abs(over) >= ends:
        return None
    return _woven(np.arange(ends) < length, shifts)


def broken(weave: Weave) -> Weave | None:
    """The broken twill with a four-end weave's picks; None for others."""
    shifts = pick_shifts(weave)
    if shifts is None or weave.matrix.shape != (4, 4):
        return None
    return _woven(weave.matrix[0] == 1, BROKEN)


def _woven(pick: NDArray[np.bool_], shifts: tuple[int, ...]) -> Weave | None:
    matrix = np.stack([np.roll(pick, shift) for shift in shifts]).astype(np.uint8)
    up = matrix.sum(axis=0)
    # An end that is never over or never under falls out of the cloth.
    return Weave(matrix, "matched") if up.min() > 0 and up.max() < len(matrix) else None
