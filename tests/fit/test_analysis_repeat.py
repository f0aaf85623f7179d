"""Lattices, patterns and the matrices that come out of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.fabric.weave import Weave, satin, twill
from usdfab.fit.analysis.patterns import grouped_plain, pattern_prior, patterns, regular_lattices
from usdfab.fit.analysis.repeat import Lattice, all_lattices, interlaces
from usdfab.fit.analysis.yarns import colour_sequence

FAMILIES = [
    ("plain", np.array([[1, 0], [0, 1]])),
    ("twill", twill(2, 2).matrix),
    ("twill", twill(3, 1, "s").matrix),
    ("satin", satin(5, 2).matrix),
    ("satin", satin(8, 3).matrix),
    ("basket", np.kron([[1, 0], [0, 1]], np.ones((2, 2), int))),
]


@given(
    family=st.sampled_from(FAMILIES),
    shift=st.tuples(st.integers(0, 7), st.integers(0, 7)),
    repeats=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    turns=st.integers(0, 3),
    mirror=st.booleans(),
)
def test_class_and_size_survive_symmetries(
    family: tuple[str, np.ndarray], shift: tuple[int, int], repeats: tuple[int, int], turns: int, mirror: bool
) -> None:
    name, matrix = family
    m = np.tile(np.roll(matrix, shift, (0, 1)), repeats)
    if mirror:
        m = m[:, ::-1]
    weave = Weave(m).rotated(turns).reduced()
    assert weave.classify() == name
    assert weave.matrix.shape == Weave(matrix).reduced().matrix.shape


@given(st.integers(1, 9), st.integers(1, 8), st.data())
def test_lattice_is_invariant_under_its_translations(width: int, height: int, data: st.DataObject) -> None:
    lattice = Lattice(width, height, data.draw(st.integers(0, width - 1)))
    ids = lattice.classes(3 * height + 2, 3 * width + 2)
    assert np.array_equal(ids[:, width:], ids[:, :-width])
    moved = lattice.classes(4 * height, 4 * width)[height:, lattice.step :]
    assert np.array_equal(moved, lattice.classes(3 * height, 4 * width - lattice.step))
    assert set(ids.ravel()) == set(range(lattice.bits))


@given(st.integers(2, 8), st.integers(1, 4), st.data())
def test_matrix_tiles_to_the_classes(width: int, height: int, data: st.DataObject) -> None:
    lattice = Lattice(width, height, data.draw(st.integers(0, width - 1)))
    table = np.array(data.draw(st.lists(st.booleans(), min_size=lattice.bits, max_size=lattice.bits)))
    matrix = lattice.matrix(table)
    rows, cols = matrix.shape
    assert np.array_equal(np.tile(matrix, (2, 2)), table[lattice.classes(2 * rows, 2 * cols)])


@pytest.mark.parametrize("lattice", regular_lattices())
def test_allowed_patterns_interlace(lattice: Lattice) -> None:
    prior = pattern_prior(lattice.width, lattice.step)
    for pattern, value in zip(patterns(lattice.width), prior, strict=True):
        assert interlaces(lattice.matrix(pattern)) == np.isfinite(value)


def test_grouped_plain_are_baskets_of_every_phase() -> None:
    for lattice, tables in grouped_plain():
        assert len(tables) == lattice.bits
        assert all(Weave(lattice.matrix(t)).classify() == "basket" for t in tables)


def test_lattices_fit_the_bounds() -> None:
    assert all(max(lattice.shape) <= 8 and lattice.bits <= 64 for lattice in all_lattices())


def test_colour_sequence() -> None:
    rng = np.random.default_rng(0)
    red, cream = np.array([0.5, 0.05, 0.05]), np.array([0.7, 0.65, 0.5])
    one = np.tile(red, (9, 1)) + 0.01 * rng.standard_normal((9, 3))
    assert colour_sequence(one).shape == (1, 3)
    two = np.array([red if k % 3 == 0 else cream for k in range(11)])
    assert np.allclose(colour_sequence(two), [red, cream, cream])
    free = rng.random((7, 3))
    assert np.array_equal(colour_sequence(free), free)
