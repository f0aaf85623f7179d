"""Weaves as binary matrices: named weaves, rotation, reduction to one repeat, classification.

Conventions (MODEL: Li et al. 2024, section 4; weavers' drafts): weft runs along +x, warp along +y. ``matrix[i, j]``
belongs to weft pick ``i``, counted from the bottom (small y), and warp end ``j``, counted from the left (small x);
1 = the weft is on top there, 0 = the warp is. A *float* is a run of cells in which a yarn stays on one side.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError

MAX_REPEAT = 512
"""Largest number of picks or ends in one repeat; real drafts stay far below."""


@dataclass(frozen=True, eq=False)
class Weave:
    """One repeat of a weave.

    Parameters
    ----------
    matrix: (picks, ends) uint8
        1 where the weft is on top. Row 0 is the lowest pick, column 0 the leftmost end. Read-only.
    name:
        The name it was made from, or ``"custom"``.

    Raises
    ------
    UsdfabError
        If the matrix is not two-dimensional and binary, or a yarn never interlaces (it would fall out of the cloth).
    """

    matrix: NDArray[np.uint8]
    name: str = "custom"

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _checked_matrix(self.matrix, f"weave '{self.name}'"))

    @classmethod
    def from_rows(cls, rows: ArrayLike | str | Iterable[str], name: str = "custom") -> Weave:
        """Make a weave from nested lists, or from text rows such as ``"10/01"``, written bottom row first."""
        if isinstance(rows, str):
            rows = [row for row in re.split(r"[/,;\s]+", rows.strip()) if row]
        items: list = list(rows)  # type: ignore[arg-type]
        if items and isinstance(items[0], str):
            if len({len(row) for row in items}) != 1 or any(set(row) - {"0", "1"} for row in items):
                raise UsdfabError(
                    "the rows are not equally long strings of 0 and 1",
                    place=f"weave '{name}'",
                    remedy="write one row per pick, bottom row first, for example 10/01 for plain",
                )
            items = [[int(c) for c in row] for row in items]
        return cls(np.asarray(items), name)

    @property
    def picks(self) -> int:
        """Number of weft yarns in one repeat (rows)."""
        return int(self.matrix.shape[0])

    @property
    def ends(self) -> int:
        """Number of warp yarns in one repeat (columns)."""
        return int(self.matrix.shape[1])

    def rows(self) -> str:
        """The matrix as text, bottom row first: ``"10/01"``."""
        return "/".join("".join(str(int(v)) for v in row) for row in self.matrix)

    def rotated(self, quarter_turns: int = 1) -> Weave:
        """The cloth turned counter-clockwise by quarter turns: warp and weft swap their roles at each."""
        matrix = self.matrix
        for _ in range(quarter_turns % 4):
            # A point (x, y) goes to (-y, x): new row = old column, new column = old rows from the top.
            # What was weft is now warp, so "weft on top" inverts.
            matrix = 1 - matrix[::-1].T
        suffix = f"_rot{90 * (quarter_turns % 4)}" if quarter_turns % 4 else ""
        return Weave(matrix, self.name + suffix)

    def tiled(self, vertical: int, horizontal: int) -> Weave:
        """Several repeats as one matrix."""
        return Weave(np.tile(self.matrix, (vertical, horizontal)), self.name)

    def reduced(self) -> Weave:
        """The smallest repeat that tiles to the same cloth."""
        matrix = self.matrix
        for axis in (0, 1):
            size = matrix.shape[axis]
            for period in range(1, size):
                if size % period == 0 and np.array_equal(np.roll(matrix, period, axis), matrix):
                    matrix = matrix[:period] if axis == 0 else matrix[:, :period]
                    break
        return Weave(matrix, self.name)

    def equivalent(self, other: Weave) -> bool:
        """Whether both describe the same cloth up to where the repeat starts (cyclic shifts)."""
        a, b = self.reduced().matrix, other.reduced().matrix
        if a.shape != b.shape:
            return False
        return any(
            np.array_equal(np.roll(np.roll(a, i, 0), j, 1), b) for i in range(a.shape[0]) for j in range(a.shape[1])
        )

    def weft_cover(self) -> float:
        """Fraction of crossings with the weft on top."""
        return float(self.matrix.mean())

    def classify(self) -> str:
        """The family: ``plain``, ``twill``, ``satin``, ``basket`` or ``other``.

        Unchanged by where the repeat starts, by mirroring and by turning the cloth. *Twill*: each pick is the one
        below shifted by one end, always the same way. *Satin*: one binding point in each row and column, shifted by
        more than one, floats of four cells or more (sateen: seen from the other side). *Basket*: a plain weave of
        groups of two or more yarns, hopsack and rib included.
        """
        matrix = self.reduced().matrix
        picks, ends = matrix.shape
        if (picks, ends) == (2, 2) and matrix[0].sum() == 1 and np.array_equal(matrix[0], 1 - matrix[1]):
            return "plain"
        if picks == ends:
            for shift in range(1, ends):
                if all(np.array_equal(np.roll(matrix[i - 1], shift), matrix[i]) for i in range(picks)):
                    if shift in (1, ends - 1):
                        return "twill"
                    if min(int(matrix[0].sum()), ends - int(matrix[0].sum())) == 1 and ends >= 5:
                        return "satin"
        if _is_grouped_plain(matrix):
            return "basket"
        return "other"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Weave) and self.name == other.name and np.array_equal(self.matrix, other.matrix)

    def __hash__(self) -> int:
        return hash((self.name, self.matrix.shape, self.matrix.tobytes()))

    def __repr__(self) -> str:
        return f"Weave({self.name!r}, {self.rows()!r})"


def _checked_matrix(matrix: ArrayLike, place: str) -> NDArray[np.uint8]:
    values = np.asarray(matrix)
    if values.ndim != 2 or 0 in values.shape:
        raise UsdfabError("a weave is a matrix with one row per pick and one column per end", place=place)
    if max(values.shape) > MAX_REPEAT:
        raise UsdfabError(f"a repeat of {values.shape[0]} x {values.shape[1]} is above {MAX_REPEAT}", place=place)
    if not np.isin(values, (0, 1)).all():
        raise UsdfabError("a weave holds only 0 (warp on top) and 1 (weft on top)", place=place)
    binary = np.ascontiguousarray(values, dtype=np.uint8)
    for label, floats in (("pick", binary), ("end", binary.T)):
        loose = [k for k, yarn in enumerate(floats) if yarn.min() == yarn.max()]
        if loose:
            raise UsdfabError(
                f"{label} {loose[0]} never interlaces, it would fall out of the cloth",
                place=place,
                remedy="every row and every column needs at least one 0 and one 1",
            )
    binary = binary.copy()
    binary.setflags(write=False)
    return binary


def _is_grouped_plain(matrix: NDArray[np.uint8]) -> bool:
    """Whether it is plain weave of groups: all groups of picks equally thick, all of ends too, and one above 1."""
    lengths = []
    for m in (matrix, matrix.T):
        if not all(np.array_equal(row, m[0]) or np.array_equal(row, 1 - m[0]) for row in m):
            return False
        changes = np.flatnonzero(m[0] != np.roll(m[0], 1))
        runs = np.diff(np.r_[changes, changes[0] + m.shape[1]])
        if len(set(runs.tolist())) != 1:
            return False
        lengths.append(int(runs[0]))
    return max(lengths) > 1


# --- constructions ---------------------------------------------------------------------------------------------------


def plain() -> Weave:
    """Over one, under one."""
    return Weave(np.array([[1, 0], [0, 1]]), "plain")


def twill(over: int, under: int, direction: str = "z", name: str | None = None) -> Weave:
    """A twill whose *warp* goes over ``over`` picks and under ``under``; ``z`` lines rise to the right, ``s`` left."""
    if over < 1 or under < 1 or over + under < 3:
        raise UsdfabError(
            f"a twill {over}/{under} needs counts of at least 1 and a repeat of at least 3", place="weave"
        )
    size = over + under
    first = np.r_[np.ones(under, dtype=np.uint8), np.zeros(over, dtype=np.uint8)]
    step = 1 if direction == "z" else -1
    matrix = np.stack([np.roll(first, step * i) for i in range(size)])
    return Weave(matrix, name or f"twill {over}/{under} {direction}")


def satin(harness: int, step: int, name: str | None = None) -> Weave:
    """A warp-faced satin: the weft is on top once in each pick, moving by ``step`` ends from pick to pick."""
    if harness < 5 or not 1 < step < harness - 1 or np.gcd(harness, step) != 1:
        raise UsdfabError(
            f"no satin with {harness} harnesses and step {step} exists",
            place="weave",
            remedy="the step is above 1, below harness - 1, and shares no divisor with the harness count",
        )
    matrix = np.zeros((harness, harness), dtype=np.uint8)
    matrix[np.arange(harness), (np.arange(harness) * step) % harness] = 1
    return Weave(matrix, name or f"satin {harness}/{step}")


def basket(picks: int, ends: int, name: str | None = None) -> Weave:
    """A plain weave of groups of ``picks`` weft yarns and ``ends`` warp yarns."""
    if picks < 1 or ends < 1:
        raise UsdfabError(f"a basket weave of {picks} x {ends} has no yarns", place="weave")
    return Weave(np.kron(plain().matrix, np.ones((picks, ends), dtype=np.uint8)), name or f"basket {picks}/{ends}")


def herringbone(over: int = 2, under: int = 2, width: int = 8, name: str | None = None) -> Weave:
    """A twill whose direction turns every ``width`` ends; at a turn the weave is offset so that no float grows."""
    unit = twill(over, under, "z").matrix
    size = over + under
    if width < size:
        raise UsdfabError(f"a herringbone stripe of {width} ends is narrower than its twill ({size})", place="weave")
    left = np.stack([unit[:, j % size] for j in range(width)], axis=1)
    # The broken turn: the returning stripe is the mirror image with warp and weft exchanged.
    right = 1 - left[:, ::-1]
    return Weave(np.concatenate([left, right], axis=1), name or "herringbone")


def _ripstop(period: int = 8) -> Weave:
    """Plain weave in which two neighbouring yarns run as one every ``period`` yarns, in both directions."""
    order = np.r_[np.arange(period - 1), period - 2]
    matrix = plain().tiled(period // 2, period // 2).matrix[np.ix_(order, order)]
    return Weave(matrix, "ripstop")


def _crepe() -> Weave:
    """A crepe made by adding the points of an 8-end sateen to a plain weave: short floats in no visible order."""
    # Shifted by one end, since unshifted the sateen's points (i, 3 i) all lie on plain's own.
    points = np.roll(satin(8, 3).matrix, 1, axis=1)
    return Weave(np.maximum(plain().tiled(4, 4).matrix, points), "crepe")


def _birdseye() -> Weave:
    """A dobby diamond ("bird's eye"): a point twill on eight ends and eight picks."""
    profile = [0, 1, 2, 3, 4, 3, 2, 1]
    unit = np.stack([np.roll([1, 1, 0, 0, 1, 0, 0, 0], k) for k in range(8)])
    return Weave(unit[np.ix_(profile, profile)], "birdseye")


def _satin_5x10() -> Weave:
    """A five-harness satin with paired ends: 5 picks, 10 ends (Chen et al. 2024, table 2: "satin 5 x 10")."""
    return Weave(np.repeat(satin(5, 2).matrix, 2, axis=1), "satin_5x10")


def _named() -> dict[str, Weave]:
    twill0, twill1, satin5 = twill(2, 1, name="twill0"), twill(3, 1, name="twill1"), satin(5, 2, name="satin")
    weaves = [
        plain(),
        twill0,
        twill0.rotated(),
        twill1,
        twill1.rotated(),
        satin5,
        satin5.rotated(),
        twill(2, 1, name="twill_3x3"),
        twill(3, 2, name="twill_5x5"),
        twill(5, 3, name="twill_8x8"),
        satin(5, 2, name="satin_5x5"),
        satin(8, 3, name="satin_8x8"),
        _satin_5x10(),
        twill(2, 2, name="twill_2_2"),
        twill(3, 1, name="denim"),
        basket(2, 2, name="basket"),
        basket(1, 2, name="oxford"),
        herringbone(),
        _ripstop(),
        _crepe(),
        _birdseye(),
        Weave(1 - satin(8, 3).matrix, "sateen_8"),
    ]
    return {w.name: w for w in weaves}


NAMED_WEAVES: dict[str, Weave] = _named()
"""Every weave that has a name. The seven classes of Li et al. 2024 are ``PAPER_WEAVES``."""

PAPER_WEAVES = ("plain", "twill0", "twill0_rot90", "twill1", "twill1_rot90", "satin", "satin_rot90")


def weave_from_name(text: str) -> Weave:
    """A weave from its name, a construction, or its rows.

    ``"plain"``, ``"herringbone"``, ... (``NAMED_WEAVES``); ``"twill 2/2 s"``, ``"satin 8/3"``, ``"basket 2/3"``; or a
    matrix written bottom row first, ``"1100/0110/0011/1001"``. Any of them may end in ``_rot90``, ``_rot180``,
    ``_rot270``.

    Raises
    ------
    UsdfabError
        For an unknown weave; the message lists the names.
    """
    key = text.strip().lower()
    if key in NAMED_WEAVES:
        return NAMED_WEAVES[key]
    turn = re.fullmatch(r"(.+)_rot(90|180|270)", key)
    if turn:
        return weave_from_name(turn[1]).rotated(int(turn[2]) // 90)
    if made := re.fullmatch(r"twill[ _-]?(\d+)[/_-](\d+)(?:[ _-]?([sz]))?", key):
        return twill(int(made[1]), int(made[2]), made[3] or "z")
    if made := re.fullmatch(r"(satin|basket)[ _-]?(\d+)[/_-](\d+)", key):
        return (satin if made[1] == "satin" else basket)(int(made[2]), int(made[3]))
    if re.fullmatch(r"[01]+([/,;\s]+[01]+)+", key):
        return Weave.from_rows(key)
    raise UsdfabError(
        f"unknown weave '{text}'",
        remedy=f"use one of {', '.join(sorted(NAMED_WEAVES))}, or 'twill 2/2', 'satin 8/3', 'basket 2/2', "
        "or rows such as 10/01",
    )
