"""The inlined elementary functions against the C library's."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, strategies as st

from usdfab.scattering.elementary_numba import (
    fast_asin,
    fast_atan2,
    fast_cos_half_turn,
    fast_exp,
    fast_log,
    fast_sincos,
)

NUMBERS = st.floats(-1e3, 1e3)


@given(NUMBERS, NUMBERS)
@example(2.2e-309, 2.2e-309)
def test_angle(y, x):
    assert abs(fast_atan2(y, x) - math.atan2(y, x)) < 2e-10


@pytest.mark.parametrize(("y", "x"), [(0.0, 1.0), (0.0, -1.0), (-0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 0.0)])
def test_angle_of_axes(y, x):
    assert fast_atan2(y, x) == pytest.approx(math.atan2(y, x), abs=1e-15)


@given(NUMBERS)
def test_sine_and_cosine(x):
    s, c = fast_sincos(x)
    assert abs(s - math.sin(x)) < 1e-12 and abs(c - math.cos(x)) < 1e-12
    assert abs(s * s + c * c - 1.0) < 1e-12


@given(st.floats(1e-300, 1e300) | st.floats(0.5, 2.0))
def test_logarithm(x):
    assert fast_log(x) == pytest.approx(math.log(x), rel=1e-11, abs=2e-12)


@given(st.floats(-690.0, 0.0))
def test_exponential(x):
    assert fast_exp(x) == pytest.approx(math.exp(x), rel=1e-10)
    assert fast_exp(-1e6) < 1e-300


@given(st.floats(-1.0, 1.0))
def test_arc_sine(x):
    assert abs(fast_asin(x) - math.asin(x)) < 4e-10


@given(st.floats(0.0, 1.0))
def test_cosine_of_half_a_turn(u):
    assert abs(fast_cos_half_turn(u) - math.cos(math.pi * u)) < 3e-11


def test_exact_values():
    assert (fast_log(1.0), fast_exp(0.0), fast_asin(0.0), fast_asin(1.0)) == (0.0, 1.0, 0.0, 0.5 * math.pi)
