"""Weaves: names, constructions, invariances of reduction and classification."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from hypothesis.extra.numpy import arrays

from usdfab.errors import UsdfabError
from usdfab.fabric import NAMED_WEAVES, PAPER_WEAVES, Weave, weave_from_name


def _interlaces(matrix: np.ndarray) -> bool:
    return all(m.min() == 0 and m.max() == 1 for a in (matrix, matrix.T) for m in a)


@st.composite
def weaves(draw: st.DrawFn) -> Weave:
    shape = draw(st.tuples(st.integers(2, 6), st.integers(2, 6)))
    matrix = draw(arrays(np.uint8, shape, elements=st.integers(0, 1), fill=st.nothing()))
    # Mend yarns that never interlace, so that few draws are wasted; all others stay as they are drawn.
    matrix = matrix ^ (np.add.outer(np.arange(shape[0]), np.arange(shape[1])) % 2).astype(np.uint8)
    for mended in (matrix, matrix.T):
        for k, line in enumerate(mended):
            if line.min() == line.max():
                line[k % len(line)] ^= 1
    assume(_interlaces(matrix))
    return Weave(matrix)


CLASSES = {
    "plain": "plain",
    "twill0": "twill",
    "twill0_rot90": "twill",
    "twill1_rot90": "twill",
    "twill_8x8": "twill",
    "twill_2_2": "twill",
    "satin": "satin",
    "satin_rot90": "satin",
    "sateen_8": "satin",
    "basket": "basket",
    "oxford": "basket",
    "herringbone": "other",
    "crepe": "other",
    "ripstop": "other",
}


@pytest.mark.parametrize(("name", "family"), CLASSES.items())
def test_family_of_named_weaves(name: str, family: str) -> None:
    assert NAMED_WEAVES[name].classify() == family


def test_the_papers_seven_classes_differ() -> None:
    seven = [NAMED_WEAVES[name] for name in PAPER_WEAVES]
    assert all(not a.equivalent(b) for i, a in enumerate(seven) for b in seven[:i])


def test_weft_cover_follows_the_counts_in_the_paper() -> None:
    # Li et al. 2024: twill0 weft over 1 under 2, twill1 over 1 under 3, satin over 1 under 4.
    assert [NAMED_WEAVES[n].weft_cover() for n in ("twill0", "twill1", "satin")] == pytest.approx([1 / 3, 1 / 4, 1 / 5])


def test_z_twill_rises_to_the_right() -> None:
    matrix = weave_from_name("twill 2/2 z").matrix
    assert np.array_equal(np.roll(matrix[0], 1), matrix[1])
    assert np.array_equal(
        np.roll(weave_from_name("twill 2/2 s").matrix[0], -1), weave_from_name("twill 2/2 s").matrix[1]
    )


def test_longest_float_of_a_herringbone_does_not_grow_at_the_turn() -> None:
    matrix = NAMED_WEAVES["herringbone"].matrix
    doubled = np.tile(matrix, (1, 2))
    longest = max(
        len(run) for row in doubled for run in "".join(map(str, row)).replace("10", "1 0").replace("01", "0 1").split()
    )
    assert longest <= 3


@given(weaves(), st.integers(1, 3), st.integers(1, 3))
def test_tiling_is_undone_by_reduction(weave: Weave, i: int, j: int) -> None:
    assert weave.tiled(i, j).reduced() == weave.reduced()


@given(weaves(), st.integers(0, 5), st.integers(0, 5))
def test_family_does_not_depend_on_where_or_how_one_looks(weave: Weave, i: int, j: int) -> None:
    family = weave.classify()
    shifted = Weave(np.roll(weave.matrix, (i, j), (0, 1)))
    assert shifted.equivalent(weave)
    assert shifted.classify() == family
    assert Weave(weave.matrix[:, ::-1]).classify() == family
    assert weave.rotated().classify() == family


@given(weaves())
def test_four_quarter_turns_are_none(weave: Weave) -> None:
    turned = weave
    for _ in range(4):
        turned = turned.rotated()
    assert np.array_equal(turned.matrix, weave.matrix)
    assert np.array_equal(weave.rotated(2).matrix, weave.matrix[::-1, ::-1])


@given(weaves())
def test_rows_as_text_come_back(weave: Weave) -> None:
    assert np.array_equal(weave_from_name(weave.rows()).matrix, weave.matrix)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("tartan", "plain"),
        ("satin 6/2", "step"),
        ("satin 5/4", "step"),
        ("twill 1/1", "repeat"),
        ("10/10", "interlaces"),
        ("10/011", "equally long"),
        ("11/01", "interlaces"),
    ],
)
def test_impossible_weaves_are_refused_with_a_reason(text: str, hint: str) -> None:
    with pytest.raises(UsdfabError, match=hint):
        weave_from_name(text)


@pytest.mark.parametrize("bad", [np.zeros((0, 2)), np.ones(4), np.full((2, 2), 2), np.array([[0.5, 1], [1, 0]])])
def test_bad_matrices_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(UsdfabError):
        Weave(bad)
