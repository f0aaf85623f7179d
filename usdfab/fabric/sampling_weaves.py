"""Random weaves for the wide prior: the paper's seven classes, other weaves with names, and drafts nobody has named."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import NAMED_WEAVES, PAPER_WEAVES, Weave, basket, satin, twill

OTHER = "other"
"""Label of every weave that is none of ``PAPER_WEAVES``."""

CLASSES = (*PAPER_WEAVES, OTHER)
"""Labels, in the order of their numbers."""

OTHER_SHARE = 0.4
"""Part of the wide prior's fabrics whose weave is none of the paper's."""

LONGEST_FLOAT = 6
"""No float of a random draft is longer, in cells."""

_TWILLS = ((3, 2), (2, 3), (4, 1), (1, 4), (3, 3), (4, 2), (2, 4), (5, 3), (4, 4))
_SATINS = ((7, 2), (7, 3), (8, 3), (8, 5), (10, 3))
_BASKETS = ((2, 2), (2, 2), (3, 3), (1, 2), (2, 1), (2, 3), (2, 4))
_FANCY = ("herringbone", "ripstop", "crepe", "birdseye", "satin_5x10")


def weave_class(weave: Weave) -> str:
    """The one of ``CLASSES`` that a weave is, wherever its repeat starts, mirror images (S for Z twills) included."""
    mirrored = Weave(weave.matrix[:, ::-1])
    for name in PAPER_WEAVES:
        if weave.equivalent(NAMED_WEAVES[name]) or mirrored.equivalent(NAMED_WEAVES[name]):
            return name
    return OTHER


def sample_weave(label: str, rng: np.random.Generator) -> Weave:
    """A random weave of a class: for the paper's, it or its mirror image; for ``other``, any kind.

    Raises
    ------
    UsdfabError
        For a label that is not in ``CLASSES``.
    """
    if label not in CLASSES:
        raise UsdfabError(f"there is no class '{label}'", remedy=f"use one of {', '.join(CLASSES)}")
    if label != OTHER:
        weave = NAMED_WEAVES[label]
        return _mirrored(weave) if rng.random() < 0.5 else weave
    while True:
        weave = _other(rng)
        if rng.random() < 0.5:
            weave = _mirrored(weave)
        if rng.random() < 0.5:
            weave = weave.rotated()
        if weave_class(weave) == OTHER:
            return weave


def _other(rng: np.random.Generator) -> Weave:
    kind = rng.choice(["twill_2_2", "twill", "satin", "basket", "fancy", "draft"], p=[0.25, 0.2, 0.12, 0.15, 0.1, 0.18])
    if kind == "twill_2_2":
        return NAMED_WEAVES["twill_2_2"]
    if kind == "twill":
        return twill(*_TWILLS[rng.integers(len(_TWILLS))])
    if kind == "satin":
        return satin(*_SATINS[rng.integers(len(_SATINS))])
    if kind == "basket":
        return basket(*_BASKETS[rng.integers(len(_BASKETS))])
    if kind == "fancy":
        return NAMED_WEAVES[_FANCY[rng.integers(len(_FANCY))]]
    return random_draft(rng)


def random_draft(rng: np.random.Generator) -> Weave:
    """A draft without a name, 4 to 10 picks and ends: a twill's line moved by a random step from pick to pick.

    As on a loom with few shafts, picks repeat a pattern with shifts; purely random matrices are cloth nobody weaves.
    """
    while True:
        ends = int(rng.integers(4, 11))
        row = rng.random(ends) < rng.uniform(0.3, 0.7)
        steps = rng.choice([-2, -1, 0, 1, 2], size=ends, p=[0.1, 0.3, 0.15, 0.35, 0.1])
        matrix = np.stack([np.roll(row, shift) for shift in np.cumsum(steps)])
        flips = rng.random(ends) < rng.uniform(0.0, 0.3)
        drawn = np.where(flips[:, None], ~matrix, matrix).astype(np.uint8)
        if max(_longest_float(m) for m in (drawn, drawn.T)) <= LONGEST_FLOAT:
            return Weave(drawn, "draft")


def _longest_float(matrix: NDArray[np.uint8]) -> int:
    """Longest run of equal cells along the rows, which repeat; more than any limit where a row never changes."""
    longest = 0
    for row in matrix:
        changes = np.flatnonzero(row != np.roll(row, 1))
        if not len(changes):
            return matrix.size
        longest = max(longest, int(np.diff(np.r_[changes, changes[0] + len(row)]).max()))
    return longest


def _mirrored(weave: Weave) -> Weave:
    return Weave(weave.matrix[:, ::-1], f"{weave.name}_mirrored")
