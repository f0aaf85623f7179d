"""What people know of the cloth on a photo, so that the analysis need not find it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import Weave, weave_from_name
from usdfab.fit.analysis.repeat import Lattice

COUNT_SLACK = 0.15
"""Logarithm by which a known count may be off: people count whole yarns on a photo that shows some in part."""

FEWEST_YARNS, MOST_YARNS = 2.0, 200.0


@dataclass(frozen=True)
class Known:
    """What is known; by default nothing.

    Parameters
    ----------
    weaves:
        One of these is the weave, beginning at any of its crossings; empty where it is not known.
    counts: (warp, weft)
        Yarns across and down the photo, within ``COUNT_SLACK``.
    """

    weaves: tuple[Weave, ...] = ()
    counts: tuple[float, float] | None = None

    def sentences(self) -> list[str]:
        """For people, to be kept with what was found."""
        said = ["the weave was given"] if self.weaves else []
        if self.counts:
            said.append(f"the counts were given, about {self.counts[0]:g} ends and {self.counts[1]:g} picks")
        return said


NOTHING = Known()


def known_weaves(text: str, place: str = "--weave") -> tuple[Weave, ...]:
    """Weaves that a name may mean on a photo, warp upright: where it says nothing of the direction, the mirror image.

    A twill's ``s`` or ``z`` says it, and so do rows of a matrix; see ``weave_from_name``.

    Raises
    ------
    UsdfabError
        For an unknown weave.
    """
    try:
        weave = weave_from_name(text)
    except UsdfabError as error:
        raise UsdfabError(error.problem, place=place, remedy=error.remedy) from error
    mirrored = Weave(weave.matrix[:, ::-1], weave.name)
    directed = re.search(r"\d[ _-]?[sz](_rot\d+)?$|^[01]", text.strip().lower()) is not None
    return (weave,) if directed or mirrored.equivalent(weave) else (weave, mirrored)


def known_counts(text: str, place: str = "--yarns") -> tuple[float, float]:
    """Counts of warp and weft from ``12x9``.

    Raises
    ------
    UsdfabError
        If these are no two numbers from ``FEWEST_YARNS`` to ``MOST_YARNS``.
    """
    number = r"(\d+(?:\.\d+)?)"
    made = re.fullmatch(rf"\s*{number}\s*[x×]\s*{number}\s*", text.lower())
    counts = tuple(float(part) for part in made.groups()) if made else ()
    if len(counts) != 2 or not all(FEWEST_YARNS <= count <= MOST_YARNS for count in counts):
        raise UsdfabError(
            f"'{text}' are no counts of yarns",
            place=place,
            remedy=f"give ends across and picks down, {FEWEST_YARNS:g} to {MOST_YARNS:g} each, e.g. 12x9",
        )
    return counts[0], counts[1]


def phases(weave: Weave) -> tuple[Lattice, NDArray[np.bool_]]:
    """A weave as the search for regular ones wants it: its lattice, and its tables (M, bits) from all crossings on."""
    matrix = weave.reduced().matrix.astype(bool)
    picks, ends = matrix.shape
    lattice = next(
        Lattice(ends, height, step)
        for height in range(1, picks + 1)
        for step in range(ends)
        if np.array_equal(np.roll(matrix, -height, 0), np.roll(matrix, step, 1))
    )
    tables = [np.roll(matrix, (a, b), (0, 1))[: lattice.height].ravel() for a in range(picks) for b in range(ends)]
    return lattice, np.unique(np.array(tables), axis=0)
