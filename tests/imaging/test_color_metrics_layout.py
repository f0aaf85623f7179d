"""Colour curves, error metrics, picture layout."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.errors import UsdfabError
from usdfab.imaging import encoded, grid, linear_to_srgb, luminance, mse, psnr, relmse, side_by_side, srgb_to_linear
from usdfab.imaging.color import decoding_table


@pytest.mark.parametrize(
    ("code", "linear"),
    [(0.0, 0.0), (0.04045, 0.04045 / 12.92), (0.5, 0.21404114048223255), (1.0, 1.0)],
)
def test_srgb_known_values(code, linear):
    assert srgb_to_linear(code) == pytest.approx(linear, rel=1e-12)


@given(st.floats(-4, 4))
def test_srgb_there_and_back(value):
    # The standard's two branches meet only to about 1e-8.
    assert srgb_to_linear(linear_to_srgb(value)) == pytest.approx(value, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("bits", [8, 16])
def test_every_code_survives_decoding_and_encoding(bits):
    table = decoding_table(bits)
    assert (np.diff(table) > 0).all()
    np.testing.assert_array_equal(encoded(table, bits), np.arange(2**bits))


def test_float32_stays_float32():
    assert srgb_to_linear(np.zeros(3, np.float32)).dtype == np.float32
    assert linear_to_srgb(np.zeros(3, np.float32)).dtype == np.float32
    assert linear_to_srgb(np.zeros(3, int)).dtype == np.float64


def test_luminance():
    assert luminance([1.0, 1.0, 1.0]) == pytest.approx(1.0)
    assert luminance(np.zeros((4, 5, 3))).shape == (4, 5)
    assert luminance([0.0, 1.0, 0.0]) > luminance([1.0, 0.0, 0.0]) > luminance([0.0, 0.0, 1.0])


def test_metrics_known_values():
    a, b = np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.4)
    assert mse(a, b) == pytest.approx(0.01)
    assert relmse(a, b) == pytest.approx(0.01 / (0.16 + 0.01))
    assert psnr(a, b) == pytest.approx(20.0)
    assert psnr(a, a) == math.inf
    assert psnr(a, b, peak=2.0) == pytest.approx(20.0 + 20 * math.log10(2))


def test_metrics_refuse_other_shapes():
    with pytest.raises(UsdfabError, match="cannot be compared"):
        mse(np.zeros((2, 3)), np.zeros((3, 2)))
    with pytest.raises(UsdfabError, match="empty"):
        relmse(np.zeros((0, 3)), np.zeros((0, 3)))


def test_side_by_side_places_pictures():
    red, grey = np.zeros((4, 6, 3)), np.full((2, 3), 0.25)
    red[..., 0] = 1
    sheet = side_by_side([red, grey], gap=2, background=(0, 0, 1))
    assert sheet.shape == (4, 11, 3) and sheet.dtype == np.float32
    np.testing.assert_array_equal(sheet[:, :6], red)
    np.testing.assert_array_equal(sheet[1:3, 8:], np.full((2, 3, 3), 0.25, np.float32))
    np.testing.assert_array_equal(sheet[0, 8], (0, 0, 1))


def test_grid_rows_and_errors():
    sheet = grid([np.ones((4, 6, 3)), np.ones((2, 3)), np.ones((5, 5, 3))], columns=2, gap=1)
    assert sheet.shape == (4 + 1 + 5, 6 + 1 + 3, 3)
    for bad in ([], [np.zeros((2, 2, 4))], [np.zeros((0, 4, 3))]):
        with pytest.raises(UsdfabError):
            grid(bad, columns=1)
    with pytest.raises(UsdfabError, match="grid"):
        grid([np.ones((2, 2))], columns=0)
