"""Rectified pictures show crossings of one size; their numbers say what gratings and colours were put in."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cloth_drawing import Cloth, draw

from usdfab.fabric.weave import NAMED_WEAVES
from usdfab.fit.network.detail import (
    ALIGN,
    BANDS,
    CELL,
    DETAIL_SIZE,
    HARMONICS,
    MOST_CELLS,
    QUANTILES,
    SLOPES,
    detail_vector,
    folded,
    rectified,
)
from usdfab.fit.network.inputs import prepared
from usdfab.fit.network.spectra import Frequency, refined, texture_maps
from usdfab.fit.network.turns import TURNS, Turn

BINS = (len(BANDS) - 1, len(SLOPES) - 1)


def parts(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Harmonics and bins of the warp, of the weft, and quantiles (4, Q), as they were before the logarithm."""
    one = HARMONICS + BINS[0] * BINS[1]
    warp, weft = (np.exp(vector[k * one : (k + 1) * one]) - 1e-6 for k in (0, 1))
    quantiles = (np.exp(vector[2 * one :]) - 1e-2).reshape(4, len(QUANTILES))
    return warp[:HARMONICS], warp[HARMONICS:].reshape(BINS), weft[:HARMONICS], weft[HARMONICS:].reshape(BINS), quantiles


def wave(u_cycles: float, v_cycles: float, cells: int = 8) -> np.ndarray:
    """(N, N, 3) a grating whose root luminance is a cosine of so many cycles per crossing, u to the right, v up."""
    steps = (np.arange(cells * CELL) + 0.5) / CELL
    u, v = np.meshgrid(steps, -steps)
    return np.repeat((1.0 + 0.3 * np.cos(2 * np.pi * (u_cycles * u + v_cycles * v)))[..., None] ** 2, 3, axis=2)


@pytest.mark.parametrize(("warp", "weft", "rotation"), [(5.2, 7.4, 0.0), (12.0, 10.0, 0.05), (30.0, 24.0, -0.04)])
def test_crossings_have_one_size_and_stand_upright(warp: float, weft: float, rotation: float) -> None:
    picture = prepared(draw(Cloth(NAMED_WEAVES["plain"].matrix, warp, weft, rotation=rotation)))
    upright = rectified(picture, *refined(texture_maps(picture), (warp, weft)))
    for sides, count in zip((upright.shape[1], upright.shape[0]), (warp, weft), strict=True):
        assert sides % ALIGN == 0 and min(CELL * MOST_CELLS, 0.8 * CELL * count) <= sides <= CELL * MOST_CELLS
    # Plain weave repeats after two crossings each way.
    root = np.sqrt(upright.mean(axis=2))
    root -= root.mean()
    for axis in (0, 1):
        length = root.shape[axis] - 3 * CELL
        lags = np.arange(int(1.3 * CELL), 3 * CELL)
        first = np.take(root, range(length), axis).ravel()
        alike = [np.corrcoef(first, np.take(root, range(k, k + length), axis).ravel())[0, 1] for k in lags]
        assert abs(int(lags[int(np.argmax(alike))]) - 2 * CELL) <= 1


@pytest.mark.parametrize("turn", TURNS)
def test_a_turned_picture_is_rectified_to_the_turned_one(turn: Turn) -> None:
    picture = np.random.default_rng(0).uniform(0.0, 1.0, (64, 64, 3)).astype(np.float32)
    found = (Frequency(6.3, 0.05), Frequency(8.1, -0.02))
    warp, weft = (f.turned(turn) for f in (found if turn.quarters % 2 == 0 else found[::-1]))
    turned = rectified(np.ascontiguousarray(turn.picture(picture)), warp, weft)
    np.testing.assert_allclose(turned, turn.picture(rectified(picture, *found)), atol=1e-3)


def test_an_even_picture_stays_and_scale_does_not_matter() -> None:
    grey = np.full((256, 256, 3), 0.3, dtype=np.float32)
    for cycles in (5.0, 13.0, 40.0):
        shown = rectified(grey, Frequency(cycles, 0.05), Frequency(9.0, -0.03))
        np.testing.assert_allclose(shown, 0.3, atol=1e-5)
    # The same cloth from two distances, both fine enough.
    steps = (np.arange(256) + 0.5) / 256 - 0.5
    waves = {n: np.cos(2 * np.pi * n * steps) for n in (8.0, 16.0)}
    near, far = (
        np.repeat((0.5 + 0.3 * np.outer(w, w))[..., None], 3, axis=2).astype(np.float32) for w in waves.values()
    )
    shown = [rectified(p, Frequency(n, 0.0), Frequency(n, 0.0)) for p, n in ((near, 8.0), (far, 16.0))]
    middle = [
        s[s.shape[0] // 2 - 60 : s.shape[0] // 2 + 60, s.shape[1] // 2 - 60 : s.shape[1] // 2 + 60] for s in shown
    ]
    np.testing.assert_allclose(middle[0], middle[1], atol=0.03)


def test_gratings_are_found_in_their_bins() -> None:
    for k in (1, 3):
        warp, _, weft, _, _ = parts(detail_vector(wave(k, 0.0)))
        assert warp[k - 1] > 0.8 and warp[k - 1] > 100 * np.delete(warp, k - 1).max() and weft.max() < 1e-3
        warp, _, weft, _, _ = parts(detail_vector(wave(0.0, k)))
        assert weft[k - 1] > 0.8 and warp.max() < 1e-3
    for slope in (-0.5, -0.15, 0.15, 0.5):
        row, column = np.searchsorted(BANDS, 5.0) - 1, np.searchsorted(SLOPES, slope) - 1
        _, bins, _, _, _ = parts(detail_vector(wave(5.0, 5.0 * slope)))
        assert (int(bins.argmax()) // BINS[1], int(bins.argmax()) % BINS[1]) == (row, column)
        # Turned by a quarter to the left, what leans over the warp leans over the weft in the same sense.
        _, _, _, turned, _ = parts(detail_vector(np.rot90(wave(5.0, 5.0 * slope), -1)))
        np.testing.assert_allclose(turned, bins, atol=1e-6)


def test_brightness_and_colours() -> None:
    pixels = np.zeros((96, 96, 3))
    pixels[:48], pixels[48:] = (0.4, 0.1, 0.1), (0.1, 0.1, 0.4)
    found = detail_vector(pixels)
    assert found.shape == (DETAIL_SIZE,) and np.isfinite(found).all()
    np.testing.assert_allclose(detail_vector(7.0 * pixels), found, atol=1e-6)
    luma = [0.2126 * 0.4 + 0.7152 * 0.1 + 0.0722 * 0.1, 0.2126 * 0.1 + 0.7152 * 0.1 + 0.0722 * 0.4]
    quantiles = parts(found)[-1] * np.mean(luma)
    np.testing.assert_allclose(quantiles[:, 1], (min(luma), 0.1, 0.1, 0.1), rtol=1e-6)
    np.testing.assert_allclose(quantiles[:, -2], (max(luma), 0.4, 0.1, 0.4), rtol=1e-6)
    assert np.isfinite(detail_vector(np.zeros((96, 96, 3)))).all()


def test_a_mirror_changes_the_sign_of_the_leaning_and_nothing_else() -> None:
    vector = np.random.default_rng(2).normal(size=DETAIL_SIZE)
    one, half = HARMONICS + BINS[0] * BINS[1], BINS[0] * BINS[1] // 2
    mirrored = vector.copy()
    leaning = np.zeros(DETAIL_SIZE, dtype=bool)
    for start in (HARMONICS, one + HARMONICS):
        bins = vector[start : start + 2 * half].reshape(BINS)
        mirrored[start : start + 2 * half] = bins[:, ::-1].ravel()
        leaning[start + half : start + 2 * half] = True
    found, turned = folded(torch.from_numpy(np.stack([vector, mirrored]))).numpy()
    assert found.shape == (DETAIL_SIZE,)
    np.testing.assert_allclose(turned, np.where(leaning, -found, found), atol=1e-12)
    # Nothing is lost: it is the same vector in another basis.
    pairs = found[np.r_[HARMONICS:one, one + HARMONICS : 2 * one]]
    assert np.square(found).sum() + np.square(pairs).sum() == pytest.approx(np.square(vector).sum())
