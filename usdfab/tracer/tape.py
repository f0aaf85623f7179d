"""What a path remembers so that its light has derivatives by the optics of fibers: forward mode, directions held fixed.

A path's light is a product of what its vertices scatter, so its derivative is that light times a sum of logarithmic
derivatives, the *score*: one addition per vertex, no second pass, nothing kept of the path. Directions are drawn from
densities that do not move with the parameters (detached sampling); so does Russian roulette end paths. What a direction
was weighed with is what is differentiated: the one lobe that was drawn, or all of them.

Layout of ``score`` and ``sums``, the same for all: colour k of the fabric has three entries from 3 k on, its albedo in
red, green, blue, each of which changes only its own channel of the picture. Then each of the two yarn systems has
gamma_M, gamma_N, gamma_M0 and the index, for each of the picture's channels: ``parameter_sums``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.scattering.fiber_numba_grad import eval_fiber_slopes, load_slopes, lobe_slopes
from usdfab.tracer.intrinsics import KERNEL

COLOR, SYSTEM = 0, 1
"""Columns of ``Tape.owners``."""
SHARED = 4
"""Parameters of a yarn system: gamma_M, gamma_N, gamma_M0, index."""


class Tape(NamedTuple):
    """Derivatives of one pixel's light; kernels write ``score`` and ``sums``.

    Parameters
    ----------
    slopes: (M, SLOPES_SIZE)
        Packed by ``pack_slopes``, beside ``Patches.materials``.
    owners: (M, 2) int32
        Colour (row of ``Optics.albedo``) and yarn system of each material; -1 for those that have no derivatives.
    score: (G,)
        Of the path: sum over its vertices of logarithmic derivatives.
    sums: (G,)
        Derivatives of the pixel's light, summed over samples.
    """

    slopes: NDArray[np.float64]
    owners: NDArray[np.int32]
    score: NDArray[np.float64]
    sums: NDArray[np.float64]


def tape_size(colors: int) -> int:
    """G: entries of ``score`` and ``sums`` for a number of colours."""
    return 3 * colors + 2 * 3 * SHARED


@njit(**KERNEL)
def start_tape(tape):
    """Before each path."""
    tape.score[:] = 0.0


@njit(**KERNEL)
def tape_light(tape, r, g, b):
    """Light (r, g, b) arrives along the path that was scattered so far."""
    score, sums = tape.score, tape.sums
    for k in range(0, len(score), 3):
        sums[k] += r * score[k]
        sums[k + 1] += g * score[k + 1]
        sums[k + 2] += b * score[k + 2]


@njit(**KERNEL, forceinline=True)
def _add(out, owners, row, slopes, r, g, b):
    """Add the 15 derivatives of one material, weighted by channel, to where its parameters are."""
    k = 3 * owners[row, COLOR]
    out[k] += r * slopes[0]
    out[k + 1] += g * slopes[1]
    out[k + 2] += b * slopes[2]
    k = len(out) - 3 * SHARED * (2 - owners[row, SYSTEM])
    for j in range(3, 15, 3):
        out[k] += r * slopes[j]
        out[k + 1] += g * slopes[j + 1]
        out[k + 2] += b * slopes[j + 2]
        k += 3


@njit(**KERNEL)
def tape_direct(tape, row, p, prepared, slopes, sin_ti, cos_ti, phi, r, g, b):
    """Light (r, g, b) came from a lamp by way of fiber material ``row``: what that scattered has derivatives too."""
    if tape.owners[row, COLOR] < 0:
        return
    (fr, fg, fb, _pdf), d = eval_fiber_slopes(
        p, load_slopes(tape.slopes, row), prepared, slopes, sin_ti, cos_ti, phi
    )
    r, g, b = r / max(fr, 1e-300), g / max(fg, 1e-300), b / max(fb, 1e-300)
    _add(tape.sums, tape.owners, row, d, r, g, b)


@njit(**KERNEL)
def tape_lobe(tape, row, p, prepared, slopes, u0, sin_ti, cos_ti, phi):
    """The path goes on in a direction that ``sample_fiber_lobe`` drew."""
    if tape.owners[row, COLOR] < 0:
        return
    d = lobe_slopes(p, load_slopes(tape.slopes, row), prepared, slopes, u0, sin_ti, cos_ti, phi)
    _add(tape.score, tape.owners, row, d, 1.0, 1.0, 1.0)


@njit(**KERNEL)
def tape_direction(tape, row, p, prepared, slopes, sin_ti, cos_ti, phi):
    """The path goes on in a direction that ``sample_fiber`` drew."""
    if tape.owners[row, COLOR] < 0:
        return
    (fr, fg, fb, _pdf), d = eval_fiber_slopes(
        p, load_slopes(tape.slopes, row), prepared, slopes, sin_ti, cos_ti, phi
    )
    _add(tape.score, tape.owners, row, d, 1.0 / max(fr, 1e-300), 1.0 / max(fg, 1e-300), 1.0 / max(fb, 1e-300))
