"""Irregular repeats: any periodic binary matrix up to 8 x 8, found by coordinate ascent on the class sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.analysis.cells import CHROMA_A, FIBERS, LUMA, ORIENTATION, CellMap
from usdfab.fit.analysis.features import Array
from usdfab.fit.analysis.patterns import BIT, PatternFit, fold, gain, pattern_variances, triple
from usdfab.fit.analysis.repeat import Lattice, all_lattices, interlaces

PRIOR = -5.0
"""Log prior of an irregular weave against plain weave, without its bits."""
SHARE = 3.0
"""Least mean number of visible crossings per free bit."""
_RANKING = (ORIENTATION, FIBERS, LUMA, CHROMA_A)
_RANKING_WEIGHTS = np.array([0.35, 0.65, 0.5, 0.5])


def best_irregular(cells: CellMap, keep: int = 3) -> list[PatternFit]:
    """The best irregular weaves on one grid, one per lattice, best first.

    Lattices are ranked by how much of the orientation and colour variance between cells their classes keep, corrected
    for the number of classes; the best of them get their matrix by flipping single crossings while the score rises.
    """
    rows, cols = cells.valid.shape
    number = int(cells.valid.sum())
    chosen: list[tuple[float, Lattice, Array, Array]] = []
    observed = cells.vectors[list(_RANKING)][:, cells.valid]
    centre, spread = observed.mean(1), observed.var(1) + 1e-12
    for lattice in all_lattices():
        if lattice.bits * SHARE > number or lattice.shape[0] > rows or lattice.shape[1] > cols:
            continue
        sums, counts = fold(cells.vectors, cells.valid, lattice)
        if counts.min() < 1:
            continue
        means = sums[list(_RANKING)] / counts
        kept = (counts * (means - centre[:, None]) ** 2).sum(1) / number / spread
        nats = -0.5 * number * np.log1p(-np.minimum(kept, 0.98)) @ _RANKING_WEIGHTS
        chosen.append((float(nats) - 0.5 * float(np.log(number)) * lattice.bits, lattice, sums, counts))
    chosen.sort(key=lambda item: -item[0])
    out = []
    for _, lattice, sums, counts in chosen[:12]:
        fit = _ascend(lattice, sums, counts)
        if fit is not None:
            out.append(fit)
    out.sort(key=lambda fit: -fit.score)
    return out[:keep]


def _ascend(lattice: Lattice, sums: Array, counts: Array) -> PatternFit | None:
    means = sums / counts
    signal = 0.35 * means[ORIENTATION] + 0.65 * means[FIBERS]
    best: tuple[float, NDArray[np.bool_], Array] | None = None
    for quantile in (0.35, 0.5, 0.65):
        table = signal < np.quantile(signal, quantile)
        score = -np.inf
        for _ in range(4 * lattice.bits):
            flips = table ^ np.eye(lattice.bits, dtype=bool)
            explained = pattern_variances(sums, counts, flips)
            values = gain(explained)
            k = int(values.argmax())
            if values[k] <= score + 1e-9:
                break
            score, table = float(values[k]), flips[k]
        if interlaces(lattice.matrix(table)) and (best is None or score > best[0]):
            best = (score, table, pattern_variances(sums, counts, table[None])[0])
    if best is None:
        return None
    score, table, explained = best
    return PatternFit(lattice, table, triple(explained), score + PRIOR - BIT * lattice.bits)
