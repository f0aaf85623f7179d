"""Drafts: from threading and treadling to the cloth and back, repeats, what a draft changes in a fabric."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from usdfab.errors import UsdfabError
from usdfab.fabric import (
    NAMED_WEAVES,
    Draft,
    DraftYarns,
    FabricParameters,
    Weave,
    YarnParameters,
    preset,
    weave_from_name,
    with_draft,
)
from usdfab.fabric.draft import compose, draft_of_drawdown, drawdown, dyed, loom_of, period
from usdfab.fabric.draft_picture import crossing_colors, draft_picture

RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


# --- the loom --------------------------------------------------------------------------------------------------------


@given(st.data())
def test_compose_is_the_product_of_two_relations(data: st.DataObject) -> None:
    rows, inner, columns = (data.draw(st.integers(1, 6)) for _ in range(3))
    a, b = data.draw(arrays(bool, (rows, inner))), data.draw(arrays(bool, (inner, columns)))
    expected = [[any(a[i, j] and b[j, k] for j in range(inner)) for k in range(columns)] for i in range(rows)]
    assert np.array_equal(compose(a, b), expected)


def test_a_straight_draw_with_a_twill_tieup() -> None:
    # 4 shafts, treadle k lifts shafts k and k + 1: the 2/2 twill whose line rises to the right.
    threading = np.eye(4, dtype=bool)
    tieup = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1], [1, 0, 0, 1]], dtype=bool)
    lift = compose(np.eye(4, dtype=bool), tieup)
    # Pick 1 (the lowest row): ends 1 and 2 are up, so the warp is on top there.
    assert drawdown(threading, lift).tolist() == [[0, 0, 1, 1], [1, 0, 0, 1], [1, 1, 0, 0], [0, 1, 1, 0]]
    # A sinking shed shows the other face.
    assert np.array_equal(drawdown(threading, lift, rising=False), 1 - drawdown(threading, lift))
    assert Weave(drawdown(threading, lift), "x").equivalent(weave_from_name("twill 2/2 z"))


@given(arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 1)))
def test_the_loom_of_a_weave_weaves_it(matrix: np.ndarray) -> None:
    if any(line.min() == line.max() for lines in (matrix, matrix.T) for line in lines):
        return
    loom = loom_of(matrix)
    threading = np.zeros((loom.shafts, matrix.shape[1]), dtype=bool)
    threading[loom.threading, np.arange(matrix.shape[1])] = True
    assert np.array_equal(drawdown(threading, loom.lift), matrix)
    # No loom with fewer shafts or treadles can: different columns need different shafts.
    assert loom.shafts == len(np.unique(matrix, axis=1).T) and loom.treadles == len(np.unique(matrix, axis=0))
    # Numbered in the order of first use.
    for numbers in (loom.threading, loom.treadling):
        first = [int(k) for k in dict.fromkeys(numbers.tolist())]
        assert first == list(range(len(first)))


# --- repeats ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 2), min_size=1, max_size=24))
def test_period_is_the_shortest_that_fits_twice(tokens: list[int]) -> None:
    n = len(tokens)
    expected = next(
        (p for p in range(1, n // 2 + 1) if all(tokens[i] == tokens[i - p] for i in range(p, n))),
        n,
    )
    assert period(tokens) == expected


def test_period_of_long_sequences() -> None:
    # In quadratic time these would take an hour.
    assert period([0] * 100_000 + [1]) == 100_001
    assert period(list(range(50_000)) * 2) == 50_000


def test_weave_and_colours_repeat_together() -> None:
    matrix = np.tile(weave_from_name("twill 2/2").matrix, (5, 6))  # 20 picks, 24 ends
    stripes = [RED] * 3 + [GREEN] * 3
    draft, repeat = draft_of_drawdown(matrix, stripes * 4, [BLUE] * 20, "twill")
    assert repeat == (4, 12)
    assert draft.weave == Weave(weave_from_name("twill 2/2").matrix, "twill")
    assert draft.warp.colors == tuple(stripes * 2) and draft.weft.colors == (BLUE,) * 4


def test_a_draft_that_ends_within_a_repeat_goes_on() -> None:
    matrix = np.tile(weave_from_name("twill 2/2").matrix, (3, 3))[:10, :11]
    draft, repeat = draft_of_drawdown(matrix, (), (), "cut")
    assert repeat == (4, 4)
    assert np.array_equal(draft.weave.matrix, weave_from_name("twill 2/2").matrix)


@given(
    st.sampled_from(sorted(NAMED_WEAVES)), st.integers(1, 3), st.integers(1, 3), st.integers(1, 5), st.integers(1, 5)
)
def test_the_repeat_rebuilds_the_drawdown(name: str, down: int, across: int, warps: int, wefts: int) -> None:
    weave = NAMED_WEAVES[name]
    matrix = np.tile(weave.matrix, (down * wefts, across * warps))
    warp = [(k / 7, 0.5, 0.5) for k in range(warps)] * (across * weave.ends)
    weft = [(0.5, k / 7, 0.5) for k in range(wefts)] * (down * weave.picks)
    draft, (picks, ends) = draft_of_drawdown(matrix, warp, weft, name)
    for axis, (length, total) in enumerate(((picks, matrix.shape[0]), (ends, matrix.shape[1]))):
        assert total % length == 0, axis
    tiled = np.tile(draft.weave.matrix, (matrix.shape[0] // draft.weave.picks, matrix.shape[1] // draft.weave.ends))
    assert np.array_equal(tiled, matrix)
    assert draft.warp.colors * (len(warp) // ends) == tuple(warp)
    assert draft.weft.colors * (len(weft) // picks) == tuple(weft)


def test_drafts_that_cannot_be_cloth() -> None:
    matrix = np.array([[1, 0, 0], [0, 1, 0]])
    with pytest.raises(UsdfabError, match="end 3 never interlaces"):
        draft_of_drawdown(matrix.astype(np.uint8), (), (), "loose")
    with pytest.raises(UsdfabError, match=r"pick 1 \(and 1 more\) never interlaces"):
        draft_of_drawdown(np.array([[1, 1], [1, 0], [0, 1], [0, 0]], dtype=np.uint8), (), (), "loose")
    rng = np.random.default_rng(1)
    with pytest.raises(UsdfabError, match="repeats after 600 picks and 600 ends, above 512"):
        draft_of_drawdown(rng.integers(0, 2, (600, 600)).astype(np.uint8), (), (), "large")


# --- fabrics ---------------------------------------------------------------------------------------------------------


def test_a_draft_sets_weave_colours_spacing_and_thickness() -> None:
    base = preset("denim")
    stripes = (RED, RED, GREEN)
    draft = Draft(
        weave_from_name("plain"), DraftYarns(stripes * 2, 1e-3, 8e-4), DraftYarns((BLUE, BLUE), 2e-3, 1.2e-3), "Stripe"
    )
    fabric = with_draft(base, draft)
    assert fabric.weave == draft.weave and fabric.name == "Stripe"
    np.testing.assert_allclose(fabric.cell, (1e-3, 2e-3))
    np.testing.assert_allclose(2 * fabric.warp.radius * fabric.warp.flattening, 8e-4)
    np.testing.assert_allclose(2 * fabric.weft.radius * fabric.weft.flattening, 1.2e-3)
    assert fabric.warp.yarn_albedo == stripes  # the shorter of its own repeats
    assert fabric.weft.yarn_albedo == () and fabric.weft.albedo == BLUE
    # Whole repeats (6 ends, 2 picks) that reach the longest side there was, 6 mm.
    assert (fabric.warp.count, fabric.weft.count) == (6, 4)
    assert fabric.size == pytest.approx((6e-3, 8e-3))
    # What a draft does not say stays.
    for name in ("fiber_count", "twist", "crimp", "flattening", "ior"):
        assert getattr(fabric.warp, name) == getattr(base.warp, name)


@given(st.floats(1e-4, 1e-2), st.sampled_from(["denim", "linen", "silk-satin"]))
def test_without_thickness_the_cover_stays(spacing: float, name: str) -> None:
    base = preset(name)
    draft = Draft(weave_from_name("plain"), DraftYarns((), spacing), DraftYarns((), spacing))
    fabric = with_draft(base, draft)
    for system in ("warp", "weft"):
        np.testing.assert_allclose(fabric.cover(system), base.cover(system))


def test_a_draft_that_says_nothing_of_size_keeps_the_yarns() -> None:
    base = preset("denim")
    fabric = with_draft(base, Draft(weave_from_name("plain")))
    np.testing.assert_allclose(fabric.cell, base.cell)
    assert fabric.warp.radius == pytest.approx(base.warp.radius) and fabric.warp.albedo == base.warp.albedo
    # One system's spacing scales the other.
    halved = with_draft(base, Draft(weave_from_name("plain"), DraftYarns((), base.cell[0] / 2)))
    np.testing.assert_allclose(halved.cell, np.asarray(base.cell) / 2)


def test_dyed_keeps_the_order_and_finds_the_shortest_sequence() -> None:
    assert dyed(YarnParameters(), (RED, GREEN, RED, GREEN)).yarn_albedo == (RED, GREEN)
    assert dyed(YarnParameters(), (RED, GREEN, GREEN)).yarn_albedo == (RED, GREEN, GREEN)
    assert dyed(YarnParameters(yarn_albedo=(RED, BLUE)), (GREEN, GREEN)).colors() == (GREEN,)


# --- pictures --------------------------------------------------------------------------------------------------------


def test_the_picture_shows_the_yarn_on_top_with_pick_1_below() -> None:
    yarn = YarnParameters()
    fabric = FabricParameters(
        Weave.from_rows("1100/0110/0011/1001", "t"),
        warp=dyed(yarn, (RED, GREEN)),
        weft=dyed(yarn, (BLUE, (0.5, 0.5, 0.5))),
    )
    colors = crossing_colors(fabric)
    assert colors[0].tolist() == [list(BLUE), list(BLUE), list(RED), list(GREEN)]
    assert colors[1].tolist() == [list(RED), [0.5] * 3, [0.5] * 3, list(GREEN)]
    picture = draft_picture(fabric, cell=1, fewest=4)
    assert picture.shape == (4 + 4 + 3, 4 + 4 + 3, 3)
    # The drawdown is at the lower left, its lowest row is pick 1; the ends' colours stand in the top row.
    assert np.array_equal(picture[-1, :4], colors[0].astype(np.float32))
    assert np.array_equal(picture[0, :4], np.array([RED, GREEN, RED, GREEN], dtype=np.float32))
    assert np.array_equal(picture[-1, -1], np.array(BLUE, dtype=np.float32))
    # Following a pick through the plans leads to the drawdown.
    threading, tieup, treadling = picture[2:6, :4, 0] == 0, picture[2:6, 5:9, 0] == 0, picture[7:, 5:9, 0] == 0
    up = treadling.astype(int) @ tieup.T.astype(int) @ threading.astype(int) > 0
    assert np.array_equal(up[::-1], fabric.weave.matrix == 0)
    with pytest.raises(UsdfabError, match="too large for a picture"):
        draft_picture(fabric, cell=4000)
