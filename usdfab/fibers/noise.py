"""Gradient noise (Perlin 1985, 2002) on arrays, differentiable where the array library is."""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array

from usdfab.fibers.randomness import hash_further, hash_integers

# The twelve directions from the centre of a cube to its edges (Perlin 2002), four of them repeated to make sixteen.
_GRADIENTS = np.array(
    [
        (1, 1, 0), (-1, 1, 0), (1, -1, 0), (-1, -1, 0), (1, 0, 1), (-1, 0, 1), (1, 0, -1), (-1, 0, -1),
        (0, 1, 1), (0, -1, 1), (0, 1, -1), (0, -1, -1), (1, 1, 0), (-1, 1, 0), (0, -1, 1), (0, -1, -1),
    ],
    dtype=np.float64,
)  # fmt: skip


def _to_numpy(array: Any) -> np.ndarray:
    return array.detach().cpu().numpy() if is_torch_array(array) else np.asarray(array)


def perlin3(x: Any, y: Any, z: Any, seed: int) -> Any:
    """Three-dimensional Perlin noise in about [-1, 1].

    Parameters
    ----------
    x, y, z:
        Coordinates, arrays of one shape; the lattice has unit spacing.
    seed:
        Chooses the lattice's gradients.
    """
    xp = array_namespace(x, y, z)
    coordinates = (x, y, z)
    floors = [np.floor(_to_numpy(c)) for c in coordinates]
    fractions = [c - xp.asarray(f, dtype=c.dtype) for c, f in zip(coordinates, floors, strict=True)]
    fades = [t * t * t * (t * (t * 6.0 - 15.0) + 10.0) for t in fractions]
    # Lattice points of the cell's corners, hashed axis by axis.
    states = [hash_integers(seed)]
    for f in floors:
        states = [hash_further(state, f + bit) for bit in range(2) for state in states]
    total: Any = 0.0
    for corner in range(8):
        bits = [(corner >> k) & 1 for k in range(3)]
        gradient = _GRADIENTS[(states[corner] >> np.uint64(60)).astype(np.int64)]
        dot: Any = 0.0
        weight: Any = 1.0
        for k in range(3):
            g = xp.asarray(np.ascontiguousarray(gradient[..., k]), dtype=x.dtype)
            dot = dot + g * (fractions[k] - bits[k])
            weight = weight * (fades[k] if bits[k] else 1.0 - fades[k])
        total = total + weight * dot
    return total
