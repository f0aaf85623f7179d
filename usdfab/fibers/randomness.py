"""Counted randomness: draws are hashes of (seed, system, yarn, fiber, segment, channel), never a running generator.

So a fiber has the same shape whatever else is generated, in whatever order and on however many threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The 64-bit finaliser of SplitMix64 (Steele, Lea, Flood 2014): every input bit reaches every output bit."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def hash_integers(*keys: ArrayLike) -> NDArray[np.uint64]:
    """A 64-bit hash of broadcast integer keys; the order of the keys matters."""
    state = np.zeros((), dtype=np.uint64)
    for key in keys:
        state = hash_further(state, key)
    return state


def hash_further(state: NDArray[np.uint64], key: ArrayLike) -> NDArray[np.uint64]:
    """``hash_integers(*keys, key)`` from ``state = hash_integers(*keys)``: what keys have in common is hashed once."""
    with np.errstate(over="ignore"):
        return _mix(np.asarray(state + _GOLDEN + np.asarray(key, dtype=np.int64).astype(np.uint64)))


def uniform(*keys: ArrayLike) -> NDArray[np.float64]:
    """U(0, 1), open at both ends, for broadcast integer keys."""
    return ((hash_integers(*keys) >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53


def normal(*keys: ArrayLike) -> NDArray[np.float64]:
    """N(0, 1) for broadcast integer keys."""
    from scipy.special import ndtri  # here: a stage without fabrics is rendered before SciPy would be loaded

    return ndtri(uniform(*keys))
