"""Weavers' drafts: threading, tie-up and treadling (or a lift plan) to a weave with coloured yarns, and back.

A loom lifts *shafts*; each warp end runs through the heddles of one (threading); each weft pick lifts some of them,
named directly (lift plan) or through treadles (treadling) to which shafts are tied (tie-up). Boolean matrices:

``threading`` (shafts, ends), ``tieup`` (treadles, shafts), ``treadling`` (picks, treadles), ``lift`` (picks, shafts)
    = treadling . tieup, and ``lift . threading`` (picks, ends): the warp is on top there (rising shed).

End 1 lies at the left (small x) and pick 1 at the bottom (small y). Drafts that are drawn with end 1 at the right and
pick 1 at the top are the same cloth turned by half a turn.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import SYSTEMS, Color, FabricParameters, System, YarnParameters
from usdfab.fabric.weave import MAX_REPEAT, Weave

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class DraftYarns:
    """The ends or the picks of one repeat.

    ``colors``: linear Rec. 709, one for each yarn of the repeat, or none. ``spacing``, ``thickness``: mean distance
    and mean width of the yarns, metres; 0 where the draft does not say.
    """

    colors: tuple[Color, ...] = ()
    spacing: float = 0.0
    thickness: float = 0.0


@dataclass(frozen=True)
class Draft:
    """What a draft says of the cloth: one repeat, its yarns, and what of the draft was ignored (``warnings``)."""

    weave: Weave
    warp: DraftYarns = field(default_factory=DraftYarns)
    weft: DraftYarns = field(default_factory=DraftYarns)
    name: str = "Draft"
    warnings: tuple[str, ...] = ()

    def yarns(self, system: System) -> DraftYarns:
        """The ends (``warp``) or the picks (``weft``)."""
        return self.warp if system == "warp" else self.weft


# --- from the loom to the cloth --------------------------------------------------------------------------------------


def compose(first: Bools, second: Bools) -> Bools:
    """(i, k) whether some j has ``first[i, j]`` and ``second[j, k]``: the product of two relations.

    Eight columns at a time, and equal rows once: thousands of yarns on thousands of shafts take a second.
    """
    packed = np.packbits(second, axis=1)
    product = np.zeros((len(first), packed.shape[1]), dtype=np.uint8)
    known: dict[bytes, NDArray[np.uint8]] = {}
    for k, row in enumerate(np.ascontiguousarray(first)):
        key = row.tobytes()
        if key not in known:
            known[key] = np.bitwise_or.reduce(packed[row], axis=0)
        product[k] = known[key]
    return np.unpackbits(product, axis=1, count=second.shape[1]).astype(bool)


def drawdown(threading: Bools, lift: Bools, rising: bool = True) -> NDArray[np.uint8]:
    """(picks, ends) 1 where the weft is on top.

    ``rising``: the shafts that a pick names go up; else they go down (sinking shed).
    """
    moved = compose(lift, threading)
    return (~moved if rising else moved).astype(np.uint8)


def period(tokens: Sequence[Hashable]) -> int:
    """After how many tokens a sequence repeats; the last repeat may be cut off, if there are two whole ones before.

    A draft of 30 ends with a straight draw on 4 shafts goes on as a straight draw. A sequence that does not repeat is
    its own period. Linear time (the prefix function of Knuth, Morris and Pratt, 1977).
    """
    length = len(tokens)
    border = [0] * length
    k = 0
    for i in range(1, length):
        while k and tokens[i] != tokens[k]:
            k = border[k - 1]
        k += tokens[i] == tokens[k]
        border[i] = k
    shortest = length - border[-1] if length else 0
    return shortest if length >= 2 * shortest else length


def draft_of_drawdown(
    matrix: NDArray[np.uint8], warp_colors: Sequence[Color], weft_colors: Sequence[Color], name: str, place: str = ""
) -> tuple[Draft, tuple[int, int]]:
    """The smallest repeat of a drawdown together with its colours, and how many picks and ends that is.

    Colours are one for each yarn, or none.

    Raises
    ------
    UsdfabError
        If the repeat is above ``MAX_REPEAT``, or an end or a pick never interlaces.
    """
    picks, ends = (
        period(_kinds([(line.tobytes(), colors[k] if colors else None) for k, line in enumerate(lines)]))
        for lines, colors in ((matrix, weft_colors), (np.ascontiguousarray(matrix.T), warp_colors))
    )
    block = matrix[:picks, :ends]
    for label, lines in (("end", block.T), ("pick", block)):
        loose = np.flatnonzero(lines.min(axis=1) == lines.max(axis=1))
        if len(loose):
            more = f" (and {len(loose) - 1} more)" if len(loose) > 1 else ""
            raise UsdfabError(
                f"{label} {loose[0] + 1}{more} never interlaces, it would fall out of the cloth", place=place
            )
    warp, weft = tuple(warp_colors[:ends]), tuple(weft_colors[:picks])
    if max(picks, ends) > MAX_REPEAT:
        raise UsdfabError(
            f"the draft repeats after {picks} picks and {ends} ends, above {MAX_REPEAT}",
            place=place,
            remedy="cut it to one pattern repeat",
        )
    return Draft(Weave(block, name).reduced(), DraftYarns(warp), DraftYarns(weft), name), (picks, ends)


def _kinds(tokens: Sequence[Hashable]) -> list[int]:
    """A small number for each token, the same for equal ones: cheaper to compare than they are."""
    numbers: dict[Hashable, int] = {}
    return [numbers.setdefault(token, len(numbers)) for token in tokens]


def with_draft(fabric: FabricParameters, draft: Draft) -> FabricParameters:
    """``fabric`` woven by ``draft``: its weave, colours, spacing and thickness, and whole repeats as its sample.

    What a draft does not say (fibers, twist, crimp, ...) stays as it was; without spacing the yarns stay as far apart
    as they were, without thickness they cover as much as before, and without colours they keep theirs. The sample
    becomes the fewest whole repeats that are at least as large as before.
    """
    cells = _cells(fabric, draft)
    yarns: dict[System, YarnParameters] = {}
    for system, spacing, before in zip(SYSTEMS, cells, fabric.cell, strict=True):
        yarn, told = fabric.system(system), draft.yarns(system)
        radius = yarn.radius * spacing / before
        if told.thickness > 0:
            radius = 0.5 * told.thickness / yarn.flattening
        yarn = replace(yarn, radius=radius)
        yarns[system] = dyed(yarn, told.colors) if told.colors else yarn
    woven = replace(fabric.with_systems(yarns), weave=draft.weave, name=draft.name)
    picks, ends = woven.repeat()
    side = max(ends * cells[0], picks * cells[1], *fabric.size)
    # Rounded before it is rounded up: 3.0000000001 repeats are 3.
    nx, ny = (max(1, math.ceil(round(side / (n * c), 9))) for n, c in ((ends, cells[0]), (picks, cells[1])))
    size = (nx * ends * cells[0], ny * picks * cells[1])
    warp, weft = replace(woven.warp, count=nx * ends), replace(woven.weft, count=ny * picks)
    return replace(woven, size=size, warp=warp, weft=weft)


def _cells(fabric: FabricParameters, draft: Draft) -> tuple[float, float]:
    """Spacing of ends and of picks in metres. What is said of one system only scales the other."""
    told = [draft.yarns(s).spacing or draft.yarns(s).thickness for s in SYSTEMS]
    before = fabric.cell
    scales = [t / b for t, b in zip(told, before, strict=True) if t > 0]
    scale = scales[0] if scales else 1.0
    dx, dy = (t if t > 0 else b * scale for t, b in zip(told, before, strict=True))
    return dx, dy


def dyed(yarn: YarnParameters, colors: Sequence[Color]) -> YarnParameters:
    """``yarn`` in these colours, one after the other; equal ones become the one ``albedo``."""
    if len(set(colors)) == 1:
        return replace(yarn, albedo=colors[0], yarn_albedo=())
    shortest = next(n for n in range(1, len(colors) + 1) if len(colors) % n == 0 and _repeats(colors, n))
    red, green, blue = (float(c) for c in np.mean(colors, axis=0))
    return replace(yarn, albedo=(red, green, blue), yarn_albedo=tuple(colors[:shortest]))


def _repeats(colors: Sequence[Color], length: int) -> bool:
    return all(colors[k] == colors[k % length] for k in range(len(colors)))


# --- from the cloth to a loom ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loom:
    """A way to set up a loom for a weave (rising shed). One shaft for each end, one treadle for each pick.

    ``threading`` (ends,) shafts and ``treadling`` (picks,) treadles, counted from 0; ``tieup`` (treadles, shafts) bool.
    """

    threading: NDArray[np.int64]
    tieup: Bools
    treadling: NDArray[np.int64]

    @property
    def shafts(self) -> int:
        """Number of shafts."""
        return int(self.tieup.shape[1])

    @property
    def treadles(self) -> int:
        """Number of treadles."""
        return int(self.tieup.shape[0])

    @property
    def lift(self) -> Bools:
        """(picks, shafts) the lift plan."""
        return self.tieup[self.treadling]


def loom_of(matrix: NDArray[np.uint8]) -> Loom:
    """The fewest shafts and treadles for a weave matrix, numbered in the order in which they are first used."""
    warp_up = matrix == 0
    threading, first_ends = _numbered(warp_up.T)
    treadling, first_picks = _numbered(warp_up)
    return Loom(threading, warp_up[np.ix_(first_picks, first_ends)], treadling)


def _numbered(lines: Bools) -> tuple[NDArray[np.int64], list[int]]:
    """Number of each line's kind in order of first appearance, and the first line of each kind."""
    kinds: dict[bytes, int] = {}
    first: list[int] = []
    numbers = []
    for k, line in enumerate(np.ascontiguousarray(lines)):
        key = line.tobytes()
        if key not in kinds:
            kinds[key] = len(first)
            first.append(k)
        numbers.append(kinds[key])
    return np.asarray(numbers, dtype=np.int64), first
