"""The joint choice of yarn lattice and weave.

Every plausible pair of spectral peaks is rectified and explained by weaves; the pair, the cell offset and the weave
with the greatest sum of evidence and prior win. So a float repeat or a colour stripe that out-shines the yarn spacing
in the spectrum loses to the grid on which the crossings make sense.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric.weave import Weave
from usdfab.fit.analysis.cells import CellMap, cell_map, channels
from usdfab.fit.analysis.features import Array, Features
from usdfab.fit.analysis.irregular import best_irregular
from usdfab.fit.analysis.known import NOTHING, Known
from usdfab.fit.analysis.patterns import PatternFit, best_regular
from usdfab.fit.analysis.rectify import SUB, Grid, Phase, build_grid, demodulate
from usdfab.fit.analysis.spectrum import Peak, axis_peaks, pair_prior, power, structure_rotation

PAIRS = 16
"""Pairs of peaks that are tried."""
SEMIFINALISTS = 5
"""Pairs for which yarn-dyed colours are allowed."""
FINALISTS = 3
"""Pairs for which irregular repeats are searched as well."""


@dataclass(frozen=True)
class Hypothesis:
    """A grid with a weave on it.

    Parameters
    ----------
    warp, weft:
        Phase fields of the two systems.
    grid:
        The rectified sampling positions.
    cells:
        Cells at the chosen offset.
    fit:
        The weave.
    score:
        Evidence plus prior, nats.
    """

    warp: Phase
    weft: Phase
    grid: Grid
    cells: CellMap
    fit: PatternFit
    score: float

    @property
    def weft_up(self) -> NDArray[np.bool_]:
        """(R, K) weft on top at each cell of the grid, row 0 at the bottom."""
        ids = self.fit.lattice.classes(*self.cells.valid.shape)
        return np.asarray(self.fit.pattern)[ids]


def rank_hypotheses(features: Features, known: Known = NOTHING) -> list[Hypothesis]:
    """All tried hypotheses, best first; empty where the photo has no pair of peaks."""
    spectrum = power(features)
    h, w = features.luma.shape
    across, down = known.counts or (None, None)
    peaks = (axis_peaks(spectrum, 0, w, near=across), axis_peaks(spectrum, 1, h, near=down))
    if not peaks[0] or not peaks[1]:
        return []
    best = (max(p.strength for p in peaks[0]), max(p.strength for p in peaks[1]))
    rotation = structure_rotation(features.luma)
    pairs = [(pair_prior(a, b, best, rotation), a, b) for a in peaks[0] for b in peaks[1]]
    pairs.sort(key=lambda item: -item[0])
    pairs = [p for p in pairs[:PAIRS] if p[0] > pairs[0][0] - 15]
    blur = 0.1 * float(np.hypot(peaks[0][0].fx, peaks[0][0].fy) * np.hypot(peaks[1][0].fx, peaks[1][0].fy)) ** -0.5
    maps = channels(features, blur)
    phases = _Phases(features, peaks)
    first = []
    for prior, a, b in pairs:
        hypothesis = _best_on_pair(maps, phases.of(a), phases.of(b), prior, known.weaves)
        if hypothesis is not None:
            first.append((hypothesis, prior))
    first.sort(key=lambda item: -item[0].score)
    first = [(_refined(maps, hypothesis, prior, known.weaves), prior) for hypothesis, prior in first[:SEMIFINALISTS]]
    first.sort(key=lambda item: -item[0].score)
    out = [hypothesis for hypothesis, _ in first]
    for hypothesis, prior in () if known.weaves else first[:FINALISTS]:
        rectified = hypothesis.grid.sample(maps)
        oy, ox = hypothesis.cells.offset
        for dy, dx in ((0, 0), (SUB // 2, 0), (0, SUB // 2), (SUB // 2, SUB // 2)):
            cells = cell_map(rectified, hypothesis.grid.inside, ((oy + dy) % SUB, (ox + dx) % SUB))
            for fit in best_irregular(cells, 1):
                out.append(replace(hypothesis, cells=cells, fit=fit, score=fit.score + prior))
    out.sort(key=lambda item: -item.score)
    return out


class _Phases:
    """Phase fields by peak, computed once each."""

    def __init__(self, features: Features, peaks: tuple[list[Peak], list[Peak]]) -> None:
        self._maps = [features.luma, features.orientation - features.orientation.mean(), features.energy]
        self._spacing = 1 / np.median([np.hypot(p.fx, p.fy) for side in peaks for p in side[:3]])
        self._known: dict[Peak, Phase] = {}

    def of(self, peak: Peak) -> Phase:
        if peak not in self._known:
            spacing = max(1 / np.hypot(peak.fx, peak.fy), self._spacing)
            self._known[peak] = demodulate(self._maps, peak, float(spacing))
        return self._known[peak]


def _best_on_pair(maps: Array, warp: Phase, weft: Phase, prior: float, weaves: tuple[Weave, ...]) -> Hypothesis | None:
    """The best regular weave over every second cell offset."""
    h, w = maps.shape[1:]
    grid = build_grid(warp, weft, (h, w))
    offsets = [(oy, ox) for oy in range(0, SUB, 2) for ox in range(0, SUB, 2)]
    rectified = grid.sample(maps)
    found = best_regular([cell_map(rectified, grid.inside, offset) for offset in offsets], weaves=weaves)
    if found is None:
        return None
    fit, cells = found
    return Hypothesis(warp, weft, grid, cells, fit, fit.score + prior)


def _refined(maps: Array, start: Hypothesis, prior: float, weaves: tuple[Weave, ...]) -> Hypothesis:
    """The same pair with yarn-dyed colours allowed, then with every cell offset next to the best one."""
    rectified = start.grid.sample(maps)
    best = (start.fit, start.cells)
    offsets = [(oy, ox) for oy in range(0, SUB, 2) for ox in range(0, SUB, 2)]
    for _ in range(2):
        cells_by_offset = [cell_map(rectified, start.grid.inside, offset) for offset in offsets]
        found = best_regular(cells_by_offset, dyed=True, weaves=weaves)
        if found is not None and found[0].score > best[0].score:
            best = found
        oy, ox = best[1].offset
        offsets = [((oy + dy) % SUB, (ox + dx) % SUB) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    fit, cells = best
    return replace(start, cells=cells, fit=fit, score=fit.score + prior)
