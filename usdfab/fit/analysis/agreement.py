"""Does the repeat really repeat? Each quarter of the photo predicted from the other three.

What rows and columns explain on their own (stripes, a single yarn system) is taken out first, so that only the
interlacing of *two* systems scores. Blobs, noise and pictures of other things have none of it.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from usdfab.fit.analysis.choose import Hypothesis
from usdfab.fit.analysis.features import Array, Features
from usdfab.fit.analysis.rectify import SUB


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
        best = max(best, _quarters(blocks, ids, cells.valid, hypothesis.fit.lattice.bits))
    return best


def _quarters(blocks: Array, ids: np.ndarray, valid: np.ndarray, bits: int) -> float:
    rows, cols = valid.shape
    i, j = np.mgrid[0:rows, 0:cols]
    ys, xs = np.flatnonzero(valid.any(1)), np.flatnonzero(valid.any(0))
    quarter = 2 * (i > ys.mean()) + (j > xs.mean())
    scores = []
    for q in range(4):
        inside, rest = valid & (quarter == q), valid & (quarter != q)
        predicted = _tiles(blocks[rest], ids[rest], bits)
        actual = _tiles(blocks[inside], ids[inside], bits)
        both = np.isfinite(predicted).all((1, 2)) & np.isfinite(actual).all((1, 2))
        if both.sum() < 2:
            return 0.0
        a, b = _interaction(actual[both]), _interaction(predicted[both])
        scores.append(float((a * b).sum() / (np.sqrt((a**2).sum() * (b**2).sum()) + 1e-12)))
    return float(np.mean(scores) - 0.5 * np.std(scores))


def _tiles(blocks: Array, ids: np.ndarray, bits: int) -> Array:
    """Mean (bits, SUB, SUB) block per class, NaN where a class is missing."""
    out = np.full((bits, SUB, SUB), np.nan)
    for k in range(bits):
        if (ids == k).any():
            out[k] = blocks[ids == k].mean(0)
    return out


def _interaction(tiles: Array) -> Array:
    """Tiles (N, SUB, SUB) without their common tile: what changes from crossing to crossing."""
    return tiles - tiles.mean(0)
