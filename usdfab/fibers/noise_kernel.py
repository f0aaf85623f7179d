"""The loop behind ``noise``, in Numba: values and gradients in one pass, with nothing kept for each lattice corner."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.fibers.randomness import _GOLDEN, _mix

_mix_one = njit(cache=True, inline="always")(_mix)


@njit(cache=True, inline="always")
def _further(state, key):
    """``randomness.hash_further`` of one integer."""
    return _mix_one(state + _GOLDEN + np.uint64(key))


# No contraction to fused operations: a fabric's fibers are the same to the last bit on every machine.
@njit(cache=True)
def perlin_values(x, y, z, seed, gradients, values, slopes):
    """Fill ``values`` (N,) with noise at places (N,) and, unless it is empty, ``slopes`` (3, N) with its gradient.

    Parameters
    ----------
    seed: int
    gradients: (16, 3)
        Of the lattice.
    """
    with_slopes = slopes.shape[1] > 0
    start = _further(np.uint64(0), np.int64(seed))
    for k in range(len(values)):
        fx, fy, fz = math.floor(x[k]), math.floor(y[k]), math.floor(z[k])
        tx, ty, tz = x[k] - fx, y[k] - fy, z[k] - fz
        ux, uy, uz = (
            tx * tx * tx * (tx * (tx * 6.0 - 15.0) + 10.0), ty * ty * ty * (ty * (ty * 6.0 - 15.0) + 10.0),
            tz * tz * tz * (tz * (tz * 6.0 - 15.0) + 10.0),
        )  # fmt: skip
        total = by_x = by_y = by_z = 0.0
        along_x = along_y = along_z = 0.0
        for cz in range(2):
            for cy in range(2):
                for cx in range(2):
                    state = _further(start, np.int64(fx) + cx)
                    state = _further(_further(state, np.int64(fy) + cy), np.int64(fz) + cz)
                    row = np.int64(state >> np.uint64(60))
                    gx, gy, gz = gradients[row, 0], gradients[row, 1], gradients[row, 2]
                    dot = gx * (tx - cx) + gy * (ty - cy) + gz * (tz - cz)
                    wx, wy, wz = (
                        ux if cx else 1.0 - ux, uy if cy else 1.0 - uy, uz if cz else 1.0 - uz
                    )  # fmt: skip
                    weight = wx * wy * wz
                    total += weight * dot
                    if with_slopes:
                        by_x, by_y, by_z = by_x + weight * gx, by_y + weight * gy, by_z + weight * gz
                        along_x += (dot if cx else -dot) * wy * wz
                        along_y += (dot if cy else -dot) * wx * wz
                        along_z += (dot if cz else -dot) * wx * wy
        values[k] = total
        if with_slopes:
            slopes[0, k] = by_x + along_x * _fade_slope(tx)
            slopes[1, k] = by_y + along_y * _fade_slope(ty)
            slopes[2, k] = by_z + along_z * _fade_slope(tz)


@njit(cache=True, inline="always")
def _fade_slope(t):
    """Of t^3 (6 t^2 - 15 t + 10)."""
    s = t * (1.0 - t)
    return 30.0 * s * s
