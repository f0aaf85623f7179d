"""Gradient noise (Perlin 1985, 2002) on arrays, differentiable where the array library is."""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array

# The twelve directions from the centre of a cube to its edges (Perlin 2002), four of them repeated to make sixteen.
_GRADIENTS = np.array(
    [
        (1, 1, 0), (-1, 1, 0), (1, -1, 0), (-1, -1, 0), (1, 0, 1), (-1, 0, 1), (1, 0, -1), (-1, 0, -1),
        (0, 1, 1), (0, -1, 1), (0, 1, -1), (0, -1, -1), (1, 1, 0), (-1, 1, 0), (0, -1, 1), (0, -1, -1),
    ],
    dtype=np.float64,
)  # fmt: skip


def perlin3(x: Any, y: Any, z: Any, seed: int) -> Any:
    """Three-dimensional Perlin noise in about [-1, 1].

    Parameters
    ----------
    x, y, z:
        Coordinates, arrays of NumPy or torch of one shape; the lattice has unit spacing. With torch the noise has
        gradients of the first order.
    seed:
        Chooses the lattice's gradients.
    """
    from usdfab.fibers.noise_kernel import perlin_values  # Numba takes a while to load

    coordinates = (x, y, z)
    places = [np.ascontiguousarray(_to_numpy(c), dtype=np.float64) for c in coordinates]
    count = places[0].size
    moving = any(is_torch_array(c) and c.requires_grad for c in coordinates)
    values, slopes = np.empty(count), np.empty((3, count if moving else 0))
    px, py, pz = (p.ravel() for p in places)
    perlin_values(px, py, pz, seed, _GRADIENTS, values, slopes)
    xp = array_namespace(x, y, z)
    noise = xp.asarray(values.reshape(places[0].shape), dtype=x.dtype)
    if moving:
        for c, slope in zip(coordinates, slopes, strict=True):
            if c.requires_grad:
                # Zero, with the noise's gradient.
                noise = noise + xp.asarray(slope.reshape(places[0].shape), dtype=x.dtype) * (c - c.detach())
    return noise


def _to_numpy(array: Any) -> np.ndarray:
    return array.detach().cpu().numpy() if is_torch_array(array) else np.asarray(array)
