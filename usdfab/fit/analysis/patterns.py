"""Regular weaves tried one by one: plain, twills, satins and every other pattern on a lattice of height 1.

A regular weave shifts each pick by the same step against the pick below, so all crossings fall into ``width`` classes.
The cell vectors are summed per class once; every binary pattern over the classes then costs one small matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import gcd

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.analysis.cells import CHROMA_A, CHROMA_B, FIBERS, LUMA, LUMA_U, LUMA_V, ORIENTATION, CellMap
from usdfab.fit.analysis.features import LUMA_WEIGHTS, Array
from usdfab.fit.analysis.repeat import Lattice

SAMPLES = 120.0
"""Independent observations that one photo is worth: weighs explained variance against prior."""
BIT = float(np.log(2.0))
CHANNEL_WEIGHTS = np.array([1.0, 0.6, 1.0])
"""Orientation, luma profile, colour: the profile tells about yarns more than about the weave."""
LEAST_TURN = 0.06
"""Explained orientation at which profile and colour count half: where the yarn on top changes, fibers must turn."""
MOST_EXPLAINED = 0.75
"""Beyond this a channel counts no more: one perfect cue must not outvote the others."""
SHRINK = 0.5
"""Weight of the mean colour of a system against one cell of a yarn."""


@dataclass(frozen=True)
class PatternFit:
    """A regular weave on a grid: lattice, pattern of the first pick, explained variances, score in nats."""

    lattice: Lattice
    pattern: NDArray[np.bool_]
    explained: tuple[float, float, float]
    score: float


@lru_cache(maxsize=32)
def patterns(width: int) -> NDArray[np.bool_]:
    """(M, width) binary patterns: all of them up to 6 wide, beyond that single runs only."""
    if width <= 6:
        codes = np.arange(1, 2**width - 1)
        return (codes[:, None] >> np.arange(width)) & 1 == 1
    rows = [np.roll(np.arange(width) < length, start) for length in range(1, width) for start in range(width)]
    return np.array(rows)


@lru_cache(maxsize=64)
def pattern_prior(width: int, step: int) -> Array:
    """(M,) log prior of each pattern: real weave families are likelier than arbitrary regular ones."""
    p = patterns(width)
    runs = (p != np.roll(p, 1, axis=1)).sum(1) // 2
    ones = p.sum(1)
    single = np.minimum(ones, width - ones) == 1
    prior = np.full(len(p), -10.0 - BIT * width)
    if step in (1, width - 1):
        simple = runs == 1
        prior[simple] = -1.0 - BIT * width
        if width == 2:
            prior[:] = -BIT * width
        # Three and four shafts are the rule; a long float is rarer on a twill lattice than on a satin lattice.
        prior[:] -= 3.0 if width > 4 else 0.0
        prior[simple & (np.maximum(ones, width - ones) > 4)] -= 3.0
    elif gcd(width, step) == 1 and width >= 5:
        prior[single] = -1.0 - BIT * width
    elif width == 4:
        prior[(runs == 1) & (ones == 2)] = -3.0 - BIT * width  # 2 x 1 basket (rib)
    # Every end must interlace: the classes that one end meets are those a multiple of gcd(width, step) apart.
    ends = p.reshape(len(p), -1, gcd(width, step))
    prior[np.any(ends.all(axis=1) | ~ends.any(axis=1), axis=1)] = -np.inf
    return prior


@lru_cache(maxsize=16)
def regular_lattices(max_width: int = 10) -> tuple[Lattice, ...]:
    """Lattices of height 1 whose picks do shift."""
    return tuple(Lattice(w, 1, s) for w in range(2, max_width + 1) for s in range(1, w))


@lru_cache(maxsize=4096)
def _membership(lattice: Lattice, rows: int, cols: int) -> Array:
    ids = lattice.classes(rows, cols).ravel()
    return (ids[:, None] == np.arange(lattice.bits)).astype(float)


def fold(vectors: Array, valid: NDArray[np.bool_], lattice: Lattice) -> tuple[Array, Array]:
    """Per class of ``lattice``: sums of the cell vectors (6, N) and counts (N,)."""
    rows, cols = valid.shape
    member = _membership(lattice, rows, cols)
    weight = valid.ravel().astype(float)
    return (vectors.reshape(len(vectors), -1) * weight) @ member, weight @ member


def pattern_variances(sums: Array, counts: Array, p: NDArray[np.bool_]) -> Array:
    """(M, 3) explained variance of orientation, luma profile and colour for patterns ``p`` (M, N)."""
    one = p.astype(float)
    n1 = one @ counts
    n0 = counts.sum() - n1
    m1 = (one @ sums.T) / np.maximum(n1, 1e-9)[:, None]
    m0 = ((1 - one) @ sums.T) / np.maximum(n0, 1e-9)[:, None]
    q = n1 / counts.sum()
    between = (q * (1 - q))[:, None] * (m1 - m0) ** 2
    signed = np.where(m0 > m1, between, 0.0)
    orientation = 0.35 * signed[:, ORIENTATION] + 0.65 * signed[:, FIBERS]
    profile = np.zeros(len(p))
    for column in (LUMA_U, LUMA_V):
        profile += q * np.maximum(m1[:, column], 0) ** 2 + (1 - q) * np.maximum(m0[:, column], 0) ** 2
    colour = between[:, LUMA] + 0.5 * (between[:, CHROMA_A] + between[:, CHROMA_B])
    return np.stack([orientation, profile, colour], axis=1)


def gain(explained: Array) -> Array:
    """Nats gained by explaining these fractions of variance (orientation, profile, colour on the last axis)."""
    nats = -0.5 * SAMPLES * np.log1p(-np.minimum(explained, MOST_EXPLAINED)) * CHANNEL_WEIGHTS
    trust = explained[..., 0] / (explained[..., 0] + LEAST_TURN)
    return nats[..., 0] + trust * (nats[..., 1] + nats[..., 2])


def best_regular(cells: CellMap, max_width: int = 8, dyed: bool = False) -> PatternFit | None:
    """The best regular weave on one grid; ``dyed`` also lets every yarn have a colour of its own."""
    rows, cols = cells.valid.shape
    out = []
    for lattice in regular_lattices(max_width):
        if lattice.width > cols or lattice.width > rows * 2:
            continue
        sums, counts = fold(cells.vectors, cells.valid, lattice)
        if counts.min() < 1:
            continue
        p = patterns(lattice.width)
        explained = pattern_variances(sums, counts, p)
        prior = pattern_prior(lattice.width, lattice.step)
        if dyed and lattice.width <= 4:
            likely = prior > -7
            own = yarn_dyed_variance(cells, p[likely][:, lattice.classes(rows, cols)])
            explained[likely, 2] = np.maximum(explained[likely, 2], own)
        score = gain(explained) + prior
        k = int(score.argmax())
        out.append(PatternFit(lattice, p[k], _triple(explained[k]), float(score[k])))
    for lattice, p in grouped_plain():
        if lattice.shape[0] > rows or lattice.shape[1] > cols:
            continue
        sums, counts = fold(cells.vectors, cells.valid, lattice)
        if counts.min() < 1:
            continue
        explained = pattern_variances(sums, counts, p)
        score = gain(explained) - 3.0 - BIT * lattice.bits
        k = int(score.argmax())
        out.append(PatternFit(lattice, p[k], _triple(explained[k]), float(score[k])))
    return max(out, key=lambda fit: fit.score, default=None)


@lru_cache(maxsize=1)
def grouped_plain() -> tuple[tuple[Lattice, NDArray[np.bool_]], ...]:
    """Plain weaves of paired yarns, which need a lattice of height 2, with all their phases: (lattice, (M, bits))."""
    out = []
    for lattice, group in ((Lattice(2, 2, 1), 1), (Lattice(4, 2, 2), 2)):
        i, j = np.mgrid[0:4, 0 : 2 * group]
        matrix = (i // 2 + j // group) % 2 == 0
        ids = lattice.classes(*matrix.shape).ravel()
        first = np.unique(ids, return_index=True)[1]
        rolls = [np.roll(matrix, (a, b), (0, 1)).ravel()[first] for a in range(4) for b in range(2 * group)]
        out.append((lattice, np.unique(np.array(rolls), axis=0)))
    return tuple(out)


def yarn_dyed_variance(cells: CellMap, weft_up: NDArray[np.bool_]) -> Array:
    """(M,) variance of cell colour explained if every yarn has a colour of its own, for matrices (M, R, K).

    Each cell is predicted from the *other* cells where the same yarn is on top, drawn towards the mean colour of its
    system, so that the many free colours do not explain noise.
    """
    valid = cells.valid
    light = cells.rgb @ LUMA_WEIGHTS
    # Brightness alone is poor evidence, gaps and shading vary it too: half weight.
    x = np.concatenate([light[..., None], cells.rgb - light[..., None]], -1)
    weight = np.array([0.5, 1.0, 1.0, 1.0])
    total = ((x[valid] - x[valid].mean(0)) ** 2).sum(0) * np.array([3.0, 1.0, 1.0, 1.0])
    error = np.zeros((len(weft_up), 4))
    for up, axis in ((weft_up & valid, 2), (~weft_up & valid, 1)):
        member = up.astype(float)
        number = member.sum(axis, keepdims=True)[..., None]
        sums = np.expand_dims(np.einsum("mrk,rkc->m" + ("r" if axis == 2 else "k") + "c", member, x), axis)
        mean = sums.sum((1, 2), keepdims=True) / np.maximum(number.sum((1, 2), keepdims=True), 1.0)
        # A cell off this system gives nonsense here; the mask below drops it.
        predicted = (sums - x + SHRINK * mean) / (np.maximum(number - 1, 0) + SHRINK)
        error += np.einsum("mrkc,mrk->mc", (x - predicted) ** 2, member)
    error *= np.array([3.0, 1.0, 1.0, 1.0])
    return (np.maximum(total - error, 0.0) @ weight) / (total.sum() + valid.sum() * cells.rgb_noise + 1e-12)


def _triple(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
