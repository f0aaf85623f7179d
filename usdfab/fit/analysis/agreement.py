"""Does the repeat really repeat? Each quarter of the photo predicted from the other three.

What rows and columns explain on their own (stripes, a single yarn system) is taken out first, so that only the
interlacing of *two* systems scores. Blobs, noise and pictures of other things have none of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.fit.analysis.choose import Hypothesis
from usdfab.fit.analysis.features import Array, Features
from usdfab.fit.analysis.rectify import SUB
from usdfab.fit.analysis.repeat import Lattice


def fold_agreement(features: Features, hypothesis: Hypothesis) -> float:
    """Correlation in [-1, 1] between the interlacing pattern of a quarter of the photo and that of the rest.

    The mean of the four quarters less half their spread, on the best of three maps (fibers, orientation, luma).
    """
    cells = hypothesis.cells
    warp, weft = hypothesis.warp, hypothesis.weft
    spacing = 1 / max(np.hypot(warp.fx, warp.fy), np.hypot(weft.fx, weft.fy))
    oy, ox = cells.offset
    rows, cols = cells.valid.shape
    ids = hypothesis.fit.lattice.classes(rows, cols)
    best = -1.0
    for m in (features.fibers, features.orientation, features.luma):
        blurred = ndimage.gaussian_filter(m, 0.1 * spacing)
        blurred = blurred - ndimage.gaussian_filter(blurred, 2.5 * spacing)
        part = hypothesis.grid.sample(blurred)[oy : oy + rows * SUB, ox : ox + cols * SUB]
        blocks = part.reshape(rows, SUB, cols, SUB).transpose(0, 2, 1, 3)
        best = max(best, _quarters(blocks, ids, cells.valid, hypothesis.fit.lattice))
    return best


def _quarters(blocks: Array, ids: NDArray[np.intp], valid: NDArray[np.bool_], lattice: Lattice) -> float:
    rows, cols = valid.shape
    i, j = np.mgrid[0:rows, 0:cols]
    ys, xs = np.flatnonzero(valid.any(1)), np.flatnonzero(valid.any(0))
    quarter = 2 * (i > ys.mean()) + (j > xs.mean())
    scores = []
    for q in range(4):
        inside, rest = valid & (quarter == q), valid & (quarter != q)
        a = _interlacing(_tiles(blocks[inside], ids[inside], lattice.bits), lattice)
        b = _interlacing(_tiles(blocks[rest], ids[rest], lattice.bits), lattice)
        scores.append(float((a * b).sum() / (np.sqrt((a**2).sum() * (b**2).sum()) + 1e-12)))
    return float(np.mean(scores) - 0.5 * np.std(scores))


def _tiles(blocks: Array, ids: NDArray[np.intp], bits: int) -> Array:
    """Mean (bits, SUB, SUB) block per class; the mean of all where a class is missing."""
    out = np.full((bits, SUB, SUB), blocks.mean(0) if len(blocks) else 0.0)
    for k in range(bits):
        if (ids == k).any():
            out[k] = blocks[ids == k].mean(0)
    return out


def _interlacing(tiles: Array, lattice: Lattice) -> Array:
    """One repeat as a picture, without what each of its lines and columns has in common."""
    rows, cols = lattice.shape
    picture = tiles[lattice.classes(rows, cols)].transpose(0, 2, 1, 3).reshape(rows * SUB, cols * SUB)
    return picture - picture.mean(0) - picture.mean(1)[:, None] + picture.mean()
