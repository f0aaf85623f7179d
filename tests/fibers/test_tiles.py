"""Which variant stands where: the same for everyone who draws cloth."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from usdfab.fabric import preset
from usdfab.fibers.tiles import TILE_CELLS, tile_copies, tile_variants
from usdfab.tracer.slab import variant_at

tiles = st.integers(-(2**31), 2**31 - 1)


@given(tiles, tiles, st.integers(1, 9))
def test_variants_are_those_of_the_tracer(column, row, count):
    assert tile_variants(column, row, count) == variant_at(0, count, column, row)


def test_all_variants_occur_equally_often():
    i, j = np.meshgrid(np.arange(-60, 60), np.arange(-60, 60))
    counts = np.bincount(tile_variants(i, j, 4).ravel(), minlength=4)
    # Chi-square with three degrees of freedom: 16.3 is exceeded once in a thousand.
    assert ((counts - 3600) ** 2 / 3600).sum() < 16.3


def test_tiles_have_enough_cells():
    fabric = preset("linen")
    picks, ends = fabric.repeat()
    copies = tile_copies(fabric)
    assert ends * copies[0] >= TILE_CELLS and picks * copies[1] >= TILE_CELLS
