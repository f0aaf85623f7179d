"""Frames as people write them."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st
from pxr import Usd

from usdfab.errors import UsdfabError
from usdfab.usd.frames import frame_times


@pytest.fixture
def stage():
    return Usd.Stage.CreateInMemory()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("5", [5.0]),
        ("-3", [-3.0]),
        ("1-4", [1, 2, 3, 4]),
        ("1:4", [1, 2, 3, 4]),
        ("4-1", [4, 3, 2, 1]),
        ("-2--1", [-2, -1]),
        ("1-10x4", [1, 5, 9]),
        ("1-10 x 4", [1, 5, 9]),
        ("10-1x4", [10, 6, 2]),
        ("0-1x.25", [0, 0.25, 0.5, 0.75, 1]),
        ("1,3, 5-6,3", [1, 3, 5, 6]),
        ("1.5", [1.5]),
    ],
)
def test_frames(stage, text, expected):
    assert frame_times(stage, text) == pytest.approx(expected)


def test_tenths_reach_the_end(stage):
    assert len(frame_times(stage, "0-1x0.1")) == 11


def test_the_whole_range(stage):
    with pytest.raises(UsdfabError, match="no start and end; name the frames"):
        frame_times(stage, "all")
    stage.SetStartTimeCode(3)
    stage.SetEndTimeCode(5)
    assert frame_times(stage, "all") == [3, 4, 5]


@pytest.mark.parametrize("text", ["", "x", "1-", "1-2-3", "1,,2", "nan", "inf", "1-5x", "1e3", "1-2y"])
def test_nonsense(stage, text):
    with pytest.raises(UsdfabError, match="is not a frame or a range; write 5, 1-10"):
        frame_times(stage, text)


@pytest.mark.parametrize(
    ("text", "problem"), [("1-5x0", "a step of 0"), ("1-5x-1", "a step of -1"), ("0-1e", "'0-1e'")]
)
def test_bad_steps(stage, text, problem):
    with pytest.raises(UsdfabError, match=problem):
        frame_times(stage, text)


def test_too_many(stage):
    with pytest.raises(UsdfabError, match="more than 1000000"):
        frame_times(stage, "0-99999999")


@given(st.integers(-500, 500), st.integers(-500, 500), st.integers(1, 50))
def test_ranges_are_pythons(first, last, step):
    stage = Usd.Stage.CreateInMemory()
    sign = 1 if last >= first else -1
    assert frame_times(stage, f"{first}-{last}x{step}") == list(range(first, last + sign, sign * step))
