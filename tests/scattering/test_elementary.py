"""The inlined elementary functions against the C library's."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, strategies as st
from numba import njit

from usdfab.scattering import elementary_numba as fast

NUMBERS = st.floats(-1e3, 1e3)


@njit
def atan2_of(y, x):
    return fast.fast_atan2(y, x)


@njit
def sincos_of(x):
    return fast.fast_sincos(x)


@njit
def log_of(x):
    return fast.fast_log(x)


@njit
def exp_of(x):
    return fast.fast_exp(x)


@njit
def asin_of(x):
    return fast.fast_asin(x)


@njit
def cos_half_turn_of(x):
    return fast.fast_cos_half_turn(x)


@given(NUMBERS, NUMBERS)
@example(2.2e-309, 2.2e-309)
def test_angle(y, x):
    assert abs(atan2_of(y, x) - math.atan2(y, x)) < 2e-10


@pytest.mark.parametrize(("y", "x"), [(0.0, 1.0), (0.0, -1.0), (-0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 0.0)])
def test_angle_of_axes(y, x):
    assert atan2_of(y, x) == pytest.approx(math.atan2(y, x), abs=1e-15)


@given(NUMBERS)
def test_sine_and_cosine(x):
    s, c = sincos_of(x)
    assert abs(s - math.sin(x)) < 1e-12 and abs(c - math.cos(x)) < 1e-12
    assert abs(s * s + c * c - 1.0) < 1e-12


@given(st.floats(1e-300, 1e300) | st.floats(0.5, 2.0))
def test_logarithm(x):
    assert log_of(x) == pytest.approx(math.log(x), rel=1e-11, abs=2e-12)


@given(st.floats(-690.0, 0.0))
def test_exponential(x):
    assert exp_of(x) == pytest.approx(math.exp(x), rel=1e-10)
    assert exp_of(-1e6) < 1e-300


@given(st.floats(-1.0, 1.0))
def test_arc_sine(x):
    assert abs(asin_of(x) - math.asin(x)) < 4e-10


@given(st.floats(0.0, 1.0))
def test_cosine_of_half_a_turn(u):
    assert abs(cos_half_turn_of(u) - math.cos(math.pi * u)) < 3e-11


def test_exact_values():
    assert (log_of(1.0), exp_of(0.0), asin_of(0.0), asin_of(1.0)) == (0.0, 1.0, 0.0, 0.5 * math.pi)
