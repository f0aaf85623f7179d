"""Fibers of one yarn that differ in albedo: melange, and the streaks of dyed yarn.

Fibers come in ``len(LEVELS)`` shades, equally many of each in every ply. Few shades keep the tracers' tables of
materials short, and a fiber is joined over the patch's border to a neighbour of its own shade (``fibers.successors``),
so that no fiber changes its colour there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEVELS = (-1.370, -0.350, 0.350, 1.370)
"""Means of a normal distribution's quarters, scaled to a standard deviation of 1."""


def drawn_shades(draws: Floats, plies: int) -> NDArray[np.int64]:
    """(yarns, fibers) the shade of each fiber, from uniform ``draws`` (yarns, fibers).

    Fiber k is in ply k mod ``plies``. Each ply has as many fibers of each shade as any other.
    """
    shade = np.empty(draws.shape, dtype=np.int64)
    for ply in range(plies):
        own = draws[:, ply::plies]
        rank = own.argsort(axis=1, kind="stable").argsort(axis=1, kind="stable")
        shade[:, ply::plies] = rank * len(LEVELS) // own.shape[1]
    return shade


def shaded_albedo(albedo: Floats, variation: float, shade: NDArray[np.int64]) -> Floats:
    """Albedo coefficients (N, 3) of fibers of the shades (N,) in yarns of ``albedo`` (N, 3).

    The coefficient maps to absorption by ``sigma_a = (ln C / q)^2`` (Chiang et al. 2015), so that ``C^e^(sigma z)``
    scales the root of the absorption, and so that of the dye in the fiber, by ``e^(sigma z)``.
    """
    return albedo ** np.exp(variation * np.asarray(LEVELS)[shade])[:, None]
