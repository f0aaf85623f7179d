"""Filters of maps that wrap around."""

from __future__ import annotations

import numpy as np
import pytest

from usdfab.tracer.bake_filter import filled, guided

RANDOM = np.random.default_rng(3)
GUIDE = RANDOM.random((24, 40, 2)).astype(np.float32)
TRUTH = np.stack([0.3 + 0.5 * GUIDE[..., 0], 0.2 + 0.1 * GUIDE[..., 1]], axis=-1)
NOISY = (TRUTH + 0.2 * RANDOM.standard_normal(TRUTH.shape)).astype(np.float32)
WEIGHT = RANDOM.integers(0, 5, (24, 40)).astype(np.float32)


def test_what_follows_the_guides_comes_out_clean() -> None:
    result = guided(NOISY, GUIDE, np.ones((24, 40), np.float32), 6)
    before, after = (np.sqrt(((x - TRUTH) ** 2).mean()) for x in (NOISY, result))
    assert after < 0.3 * before


def test_exact_linear_functions_stay() -> None:
    result = guided(TRUTH.astype(np.float32), GUIDE, WEIGHT, 4)
    assert result == pytest.approx(TRUTH, abs=5e-3)


def test_the_mean_stays() -> None:
    flat = np.ones((24, 40), np.float32)
    result = guided(NOISY, GUIDE, flat, 5)
    assert result.mean(axis=(0, 1)) == pytest.approx(NOISY.mean(axis=(0, 1)), rel=1e-5)


def test_the_map_wraps_around() -> None:
    """Rolling the input rolls the output: no border is special."""
    shift = (7, -11)
    rolled = guided(*(np.roll(a, shift, (0, 1)) for a in (NOISY, GUIDE, WEIGHT)), 3)
    assert rolled == pytest.approx(np.roll(guided(NOISY, GUIDE, WEIGHT, 3), shift, (0, 1)), abs=1e-5)


def test_constant_guides_and_small_maps_do_no_harm() -> None:
    result = guided(NOISY[:3, :4], np.ones((3, 4, 2), np.float32), np.ones((3, 4), np.float32), 9)
    assert np.isfinite(result).all()
    assert result == pytest.approx(np.broadcast_to(NOISY[:3, :4].mean(axis=(0, 1)), result.shape), abs=0.15)


def test_texels_without_weight_do_not_count() -> None:
    spoiled, weight = TRUTH.astype(np.float32).copy(), np.ones((24, 40), np.float32)
    spoiled[5:8, 9:12], weight[5:8, 9:12] = 100.0, 0.0
    assert guided(spoiled, GUIDE, weight, 4) == pytest.approx(TRUTH, abs=1e-2)


def test_holes_are_filled_from_around_them_and_across_the_border() -> None:
    values = np.full((16, 16, 1), 2.0, np.float32)
    weight = np.ones((16, 16), np.float32)
    values[:6, :5], weight[:6, :5] = -9.0, 0.0
    assert filled(values, weight) == pytest.approx(2.0, abs=1e-4)
    assert np.array_equal(filled(values, np.zeros((16, 16), np.float32)), values), "nothing is known: nothing changes"
