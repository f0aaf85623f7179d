"""Counted randomness in kernels: SplitMix64 streams keyed by (seed, pixel, sample).

A stream is one uint64. Nothing is shared, so the picture does not depend on threads, tiles or order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_A = np.uint64(0xBF58476D1CE4E5B9)
_B = np.uint64(0x94D049BB133111EB)


@njit(cache=True, inline="always")
def mix(x):
    """The 64-bit finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    x = (x ^ (x >> np.uint64(30))) * _A
    x = (x ^ (x >> np.uint64(27))) * _B
    return x ^ (x >> np.uint64(31))


@njit(cache=True, inline="always")
def start_stream(seed, pixel, sample):
    """The stream of one sample of one pixel."""
    return mix(mix(mix(np.uint64(seed) + _GOLDEN) + np.uint64(pixel)) + np.uint64(sample) + _GOLDEN)


@njit(cache=True, inline="always")
def next_uniform(stream):
    """(stream, u): the next number of the stream, in [0, 1)."""
    stream = stream + _GOLDEN
    return stream, np.float64(mix(stream) >> np.uint64(11)) * 2.0**-53
