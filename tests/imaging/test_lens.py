"""One signed number for a camera's sharpness: a linear map, symmetric, smooth at sharp, the same in numpy and torch.
And one for its contrast, which can be undone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from scipy.ndimage import gaussian_filter

from usdfab.imaging.lens import PIVOT, photographed, through_lens, through_lens_torch, toned

PICTURE = np.random.default_rng(0).random((18, 27, 3))


@given(blur=st.floats(-3.0, 3.0))
def test_light_is_kept_and_the_map_is_its_own_transpose(blur: float) -> None:
    other = np.random.default_rng(1).random(PICTURE.shape)
    seen = through_lens(PICTURE, blur)
    np.testing.assert_allclose(seen.sum(axis=(0, 1)), PICTURE.sum(axis=(0, 1)))
    assert np.sum(other * seen) == pytest.approx(np.sum(PICTURE * through_lens(other, blur)))
    np.testing.assert_allclose(through_lens(np.full((9, 8, 3), 0.4), blur), 0.4)
    as_torch = through_lens_torch(torch.from_numpy(PICTURE).permute(2, 0, 1), blur).permute(1, 2, 0)
    np.testing.assert_allclose(as_torch.numpy(), seen, atol=1e-12)


@pytest.mark.parametrize("deviation", [1.5, 3.0])
def test_a_blur_is_a_gaussian(deviation: float) -> None:
    """Sampled kernels of this width are Gaussians to 1e-4; narrower ones are not."""
    expected = gaussian_filter(PICTURE, (deviation, deviation, 0), mode="reflect", truncate=6)
    np.testing.assert_allclose(through_lens(PICTURE, deviation), expected, atol=2e-4)


def test_blurs_add_up_by_their_squares() -> None:
    twice = through_lens(through_lens(PICTURE, 0.6), 0.8)
    np.testing.assert_allclose(through_lens(PICTURE, 1.0), twice, atol=1e-12)


def test_sharpening_is_the_other_side_of_blurring() -> None:
    """Near sharp both change pictures equally fast in ``b |b|``; beyond, edges overshoot."""
    step = 1e-4
    up = (through_lens(PICTURE, np.sqrt(step)) - PICTURE) / step
    down = (PICTURE - through_lens(PICTURE, -np.sqrt(step))) / step
    np.testing.assert_allclose(up, down, atol=1e-2 * abs(up).max())
    edge = np.zeros((16, 16, 1))
    edge[:, 8:] = 1.0
    assert through_lens(edge, -1.0).max() > 1.1 and through_lens(edge, -1.0).min() < -0.1
    # The grid ends the Gaussian's frequencies where they are 0.7 %: that much rings.
    assert through_lens(edge, 1.0).max() < 1.005


def test_a_photo_is_not_below_black() -> None:
    assert through_lens(PICTURE, -2.0).min() < 0.0 == photographed(PICTURE, -2.0).min()
    np.testing.assert_array_equal(photographed(PICTURE, 2.0), through_lens(PICTURE, 2.0))


@given(contrast=st.floats(0.3, 3.0))
def test_contrast_is_undone_by_its_inverse_and_keeps_middle_grey(contrast: float) -> None:
    seen = toned(PICTURE, contrast)
    np.testing.assert_allclose(toned(seen, 1.0 / contrast), PICTURE, rtol=1e-9, atol=1e-12)
    assert toned(np.full(1, PIVOT), contrast) == pytest.approx(PIVOT)
    # Ratios of light are what becomes more or less.
    np.testing.assert_allclose(np.log(seen[0] / seen[1]), contrast * np.log(PICTURE[0] / PICTURE[1]), atol=1e-9)
    assert toned(np.zeros(1), contrast) == 0.0


def test_a_photo_is_through_the_lens_then_exposed_then_toned() -> None:
    expected = toned(1.7 * np.maximum(through_lens(PICTURE, -1.2), 0.0), 1.3)
    np.testing.assert_allclose(photographed(PICTURE, -1.2, 1.7, 1.3), expected)
    single = photographed(PICTURE.astype(np.float32), -1.2, 1.7, 1.3)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, rtol=1e-4, atol=1e-6)


def test_many_pictures_at_once_and_their_type() -> None:
    stack = np.stack([PICTURE, 2 * PICTURE]).astype(np.float32)
    seen = through_lens(stack, 0.7)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[1], through_lens(2 * PICTURE, 0.7), atol=1e-5)
    assert through_lens(stack, 0.0) is stack
