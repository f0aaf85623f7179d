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

from usdfab.fabric.weave import Weave
from usdfab.fit.analysis.cells import CHROMA_A, CHROMA_B, FIBERS, LUMA, LUMA_U, LUMA_V, ORIENTATION, CellMap
from usdfab.fit.analysis.features import LUMA_WEIGHTS, Array
from usdfab.fit.analysis.known import phases
from usdfab.fit.analysis.repeat import Lattice

SAMPLES = 120.0
"""Independent observations that one photo is worth: weighs explained variance against prior."""
BIT = float(np.log(2.0))
LEAST_CELLS = 9
"""Fewest whole crossings from which a weave is read."""
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
        prior[:] -= 4.0 if width > 4 else 0.0
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
    """Per class of ``lattice``: sums of the cell vectors (..., 7, R, K) -> (..., 7, N), and counts (..., N)."""
    rows, cols = valid.shape[-2:]
    member = _membership(lattice, rows, cols)
    weight = valid.reshape(*valid.shape[:-2], rows * cols).astype(float)
    flat = vectors.reshape(*vectors.shape[:-2], rows * cols)
    return (flat * weight[..., None, :]) @ member, weight @ member


def pattern_variances(sums: Array, counts: Array, p: NDArray[np.bool_]) -> Array:
    """(..., M, 3) explained variance of orientation, luma profile and colour for patterns ``p`` (M, N).

    ``sums`` (..., 7, N) and ``counts`` (..., N) are those of :func:`fold`.
    """
    one = p.T.astype(float)
    total = counts.sum(-1)[..., None]
    n1 = counts @ one
    sum1 = sums @ one
    m1 = sum1 / np.maximum(n1, 1e-9)[..., None, :]
    m0 = (sums.sum(-1)[..., None] - sum1) / np.maximum(total - n1, 1e-9)[..., None, :]
    q = n1 / total
    between = (q * (1 - q))[..., None, :] * (m1 - m0) ** 2
    turned = np.where(m0 > m1, between, 0.0)
    orientation = 0.35 * turned[..., ORIENTATION, :] + 0.65 * turned[..., FIBERS, :]
    profile = np.zeros(q.shape)
    for column in (LUMA_U, LUMA_V):
        profile += q * np.maximum(m1[..., column, :], 0) ** 2 + (1 - q) * np.maximum(m0[..., column, :], 0) ** 2
    colour = between[..., LUMA, :] + 0.5 * (between[..., CHROMA_A, :] + between[..., CHROMA_B, :])
    return np.stack([orientation, profile, colour], axis=-1)


def gain(explained: Array) -> Array:
    """Nats gained by explaining these fractions of variance (orientation, profile, colour on the last axis)."""
    nats = -0.5 * SAMPLES * np.log1p(-np.minimum(explained, MOST_EXPLAINED)) * CHANNEL_WEIGHTS
    trust = explained[..., 0] / (explained[..., 0] + LEAST_TURN)
    return nats[..., 0] + trust * (nats[..., 1] + nats[..., 2])


def best_regular(
    cells: list[CellMap], max_width: int = 8, dyed: bool = False, weaves: tuple[Weave, ...] = ()
) -> tuple[PatternFit, CellMap] | None:
    """The best regular weave over several cell offsets of one grid, with the offset it was found at.

    ``dyed`` also lets every yarn have a colour of its own. All offsets must have the same number of cells. Where the
    weave is known to be one of ``weaves``, regular or not, only these are tried.
    """
    cells = [c for c in cells if c.valid.sum() >= LEAST_CELLS]
    if not cells:
        return None
    vectors, valid = np.stack([c.vectors for c in cells]), np.stack([c.valid for c in cells])
    rows, cols = valid.shape[1:]
    best: tuple[PatternFit, CellMap] | None = None
    for lattice, p, prior in _known_weaves(weaves) if weaves else _regular_weaves(max_width):
        if not weaves and (lattice.width > cols or lattice.shape[0] > 2 * rows):
            continue
        sums, counts = fold(vectors, valid, lattice)
        explained = pattern_variances(sums, counts, p)
        if dyed and (weaves or lattice.bits <= 4):
            likely = prior > -7
            matrices = p[likely][:, lattice.classes(rows, cols)]
            own = np.stack([yarn_dyed_variance(c, matrices) for c in cells])
            explained[:, likely, 2] = np.maximum(explained[:, likely, 2], own)
        score = gain(explained) + prior
        if not weaves:
            score[counts.min(1) < 1] = -np.inf
        b, k = np.unravel_index(int(score.argmax()), score.shape)
        if np.isfinite(score[b, k]) and (best is None or score[b, k] > best[0].score):
            best = (PatternFit(lattice, p[k], triple(explained[b, k]), float(score[b, k])), cells[b])
    return best


@lru_cache(maxsize=4)
def _regular_weaves(max_width: int) -> tuple[tuple[Lattice, NDArray[np.bool_], Array], ...]:
    """(lattice, patterns, their log prior) of everything :func:`best_regular` tries."""
    out = [(x, patterns(x.width), pattern_prior(x.width, x.step)) for x in regular_lattices(max_width)]
    return tuple(out + [(x, p, np.full(len(p), -3.0 - BIT * x.bits)) for x, p in grouped_plain()])


@lru_cache(maxsize=4)
def _known_weaves(weaves: tuple[Weave, ...]) -> tuple[tuple[Lattice, NDArray[np.bool_], Array], ...]:
    """The same of weaves that are known: none is likelier than the others."""
    found = [phases(weave) for weave in weaves]
    return tuple((lattice, tables, np.zeros(len(tables))) for lattice, tables in found)


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


def triple(v: Array) -> tuple[float, float, float]:
    """Three numbers of an array as a tuple."""
    return float(v[0]), float(v[1]), float(v[2])
