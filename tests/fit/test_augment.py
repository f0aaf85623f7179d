"""Augmentation: each step does what it says, by means, variances and known cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.fit.dataset.augment import (
    LUMINANCE,
    MIDDLE_GREY,
    PLAIN,
    blurred,
    exposure_gain,
    jpeg,
    noisy,
    photographed,
    sample_camera,
    saturated,
    sharpened,
    unevenly_lit,
)
from usdfab.srgb import linear_to_srgb

RNG = np.random.default_rng(0)
PICTURE = RNG.uniform(0.05, 0.8, (40, 56, 3)).astype(np.float32)


def test_a_plain_camera_only_encodes() -> None:
    seen = photographed(PICTURE, PLAIN, np.random.default_rng(1))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, linear_to_srgb(PICTURE), atol=0.5 / 255 + 1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_any_camera_gives_a_picture_and_the_same_one_again(seed: int) -> None:
    def once() -> np.ndarray:
        rng = np.random.default_rng(seed)
        return photographed(PICTURE, sample_camera(rng), rng)

    seen = once()
    assert seen.shape == PICTURE.shape and seen.dtype == np.float32
    assert seen.min() >= 0.0 and seen.max() <= 1.0
    np.testing.assert_array_equal(seen, once())


@pytest.mark.parametrize(
    "step",
    [
        lambda x: unevenly_lit(x, (0.1, -0.07), 0.2),
        lambda x: blurred(x, 1.3),
        lambda x: sharpened(x, 1.5, 1.2),
    ],
    ids=["lighting", "blur", "sharpening"],
)
def test_steps_that_keep_the_mean(step) -> None:
    # Uncorrelated with the lighting's field up to chance; an even picture shows the rule itself.
    even = np.full((40, 56, 3), 0.3, dtype=np.float32)
    np.testing.assert_allclose(step(even).mean(axis=(0, 1), dtype=float), 0.3, rtol=1e-5)
    np.testing.assert_allclose(step(PICTURE).mean(axis=(0, 1), dtype=float), PICTURE.mean(axis=(0, 1)), rtol=5e-3)
    assert np.abs(step(PICTURE) - PICTURE).max() > 0.01


def test_lighting_rises_to_the_right_and_to_the_top() -> None:
    lit = unevenly_lit(np.ones((20, 20, 3), dtype=np.float32), (0.2, 0.1), 0.0)
    assert lit[10, -1, 0] > lit[10, 0, 0]
    assert lit[0, 10, 0] > lit[-1, 10, 0]
    dark = unevenly_lit(np.ones((20, 20, 3), dtype=np.float32), (0.0, 0.0), 0.3)
    assert dark[0, 0, 0] < dark[10, 0, 0] < dark[10, 10, 0]


def test_noise_has_mean_zero_and_the_variance_that_is_said() -> None:
    even = np.full((300, 300, 3), 0.4, dtype=np.float32)
    shot, read = 1e-3, 1e-2
    noise = noisy(even, shot, read, np.random.default_rng(2)) - even
    variance = shot * 0.4 + read**2
    n = noise.size
    assert abs(noise.mean()) < 5 * np.sqrt(variance / n)
    assert noise.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / n))


def test_metering_makes_pictures_equally_bright() -> None:
    camera = replace(PLAIN, metering=1.0)
    for scale in (0.1, 1.0, 3.0):
        picture = scale * PICTURE
        assert (picture * exposure_gain(picture, camera) @ LUMINANCE).mean() == pytest.approx(MIDDLE_GREY, rel=1e-4)
    assert exposure_gain(PICTURE, replace(PLAIN, exposure=1.0)) == pytest.approx(2.0)


def test_saturation_keeps_luminance_and_zero_is_grey() -> None:
    for amount in (0.0, 0.7, 1.4):
        np.testing.assert_allclose(saturated(PICTURE, amount) @ LUMINANCE, PICTURE @ LUMINANCE, atol=1e-5)
    grey = saturated(PICTURE, 0.0)
    np.testing.assert_allclose(grey[..., 0], grey[..., 2], atol=1e-6)


def test_blur_takes_detail_and_sharpening_gives_it_back() -> None:
    soft = blurred(PICTURE, 1.0)
    assert soft.std() < PICTURE.std() < sharpened(PICTURE, 1.0, 1.0).std()


@pytest.mark.parametrize("level", [0.0, 0.25, 0.5, 1.0])
def test_jpeg_keeps_even_grey(level: float) -> None:
    # An even block has one coefficient, 8 times its level; the coarsest step at quality 90 is 3.
    out = jpeg(np.full((24, 40, 3), level, dtype=np.float32), 90)
    np.testing.assert_allclose(out, level, atol=0.5 * 3 / 8 / 255 + 1e-4)


def test_jpeg_errors_fall_with_quality_and_agree_with_a_real_encoder(tmp_path) -> None:
    from usdfab.imaging import read_image, write_image
    from usdfab.srgb import srgb_to_linear

    smooth = np.clip(blurred(PICTURE, 2.0) * 1.5 - 0.2, 0.0, 1.0)
    errors = [np.sqrt(np.mean((jpeg(smooth, q) - smooth) ** 2)) for q in (95, 70, 30, 5)]
    assert errors == sorted(errors)
    # OpenImageIO writes quality 95 without reducing the chroma: its error must be a little smaller than ours.
    path = write_image(tmp_path / "a.jpg", srgb_to_linear(smooth))
    real = np.sqrt(np.mean((linear_to_srgb(read_image(path).pixels) - smooth) ** 2))
    assert 0.5 * real < errors[0] < 3.0 * real
