"""Vectors of sixteen numbers in compiled code, against NumPy."""

import numpy as np
from numba import njit

from usdfab.neural import simd
from usdfab.neural.simd import LANES, gather, invert, lanes, least, load, most, store, to_floats, to_integers, where
from usdfab.neural.simd_math import exp, fraction, inverse_length, log2


@njit
def _sums(a, b, k, out):
    x, y, n = load(a, 0), load(b, 0), load(k, 0)
    store(out, 0, where((x < y) & invert(x < 0.25), x * 2.0 + y, 1.5 - x / (y + 1.0)))
    store(out, LANES, most(least(x, 0.75), 0.25) + simd.root(simd.size_of(x - y)))
    store(out, 2 * LANES, to_floats(((n + 3) & 7) ^ (n << 1)) - to_floats(n >> 1) * 2.0)
    store(out, 3 * LANES, gather(a, lanes() ^ 5) + to_floats(to_integers(y * 10.0)))
    return simd.bits_of(x > y)


def test_operators_agree_with_numpy():
    rng = np.random.default_rng(2)
    a, b = rng.random((2, LANES), dtype=np.float32)
    k, out = rng.integers(-9, 9, LANES).astype(np.int32), np.zeros(4 * LANES, dtype=np.float32)
    mask = _sums(a, b, k, out)
    found = out.reshape(4, LANES)
    assert np.allclose(found[0], np.where((a < b) & ~(a < 0.25), 2 * a + b, 1.5 - a / (b + 1)), rtol=1e-6)
    assert np.allclose(found[1], a.clip(0.25, 0.75) + np.sqrt(np.abs(a - b)), rtol=1e-6)
    assert np.array_equal(found[2], ((k + 3 & 7) ^ (k << 1)) - (k >> 1) * 2)
    assert np.allclose(found[3], a[np.arange(LANES) ^ 5] + np.floor(10 * b))
    assert [mask >> lane & 1 for lane in range(LANES)] == (a > b).astype(int).tolist()


@njit
def _apply(x, out):
    for k in range(0, len(x), LANES):
        v = load(x, k)
        store(out, k, exp(v))
        store(out, len(x) + k, log2(simd.size_of(v) + 1e-6))
        store(out, 2 * len(x) + k, fraction(v))
        store(out, 3 * len(x) + k, inverse_length(v, v * 0.0, v * 0.0))


def test_functions_agree_with_numpy():
    x = np.linspace(-12, 9, 64 * LANES, dtype=np.float32)
    out = np.zeros((4, len(x)), dtype=np.float32)
    _apply(x, out.reshape(-1))
    wide = x.astype(float)
    assert np.allclose(out[0], np.exp(wide), rtol=2e-6)
    assert np.allclose(out[1], np.log2(np.abs(wide) + 1e-6), atol=1e-6)
    assert np.allclose(out[2], wide - np.floor(wide), atol=1e-6) and out[2].min() >= 0 and out[2].max() < 1
    assert np.allclose(out[3], 1 / np.abs(wide), rtol=1e-6)


def test_transpose():
    square = np.random.default_rng(0).random((LANES, LANES), dtype=np.float32)
    out = np.zeros((LANES, 20), dtype=np.float32)

    @njit
    def turn(source, target):
        simd.transpose(source, 0, target, 3, 20)

    turn(square.reshape(-1), out.reshape(-1))
    assert np.array_equal(out[:, 3:19], square.T) and not out[:, :3].any() and not out[:, 19:].any()
