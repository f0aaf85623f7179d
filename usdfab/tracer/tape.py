"""What a path remembers so that its light has derivatives by the optics of fibers: forward mode, directions held fixed.

A path's light is a product of what its vertices scatter, so its derivative is that light times a sum of logarithmic
derivatives, the *score*: one addition per vertex, no second pass, nothing kept of the path. Directions are drawn from
densities that do not move with the parameters (detached sampling); so does Russian roulette end paths. What is
differentiated is the one lobe that was drawn, A M D: its attenuation goes into ``score``, the rest, which does not
depend on colour and is 0 in the mean, into ``drift``.

Most of the noise is the drift's: light that comes many vertices later hardly depends on a direction any more, but is
multiplied by its score all the same. ``keep`` below 1 lets the drift fade by this factor at each further vertex: a
little bias for much less noise.

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
        Of the path: sum over its vertices of the attenuations' logarithmic derivatives.
    drift: (2 SHARED,)
        The same of the directions', for each system its four parameters.
    keep: float
        What of the drift is left after a further vertex; 1: no bias.
    sums: (G,)
        Derivatives of the pixel's light, summed over samples.
    """

    slopes: NDArray[np.float64]
    owners: NDArray[np.int32]
    score: NDArray[np.float64]
    drift: NDArray[np.float64]
    keep: float
    sums: NDArray[np.float64]


def tape_size(colors: int) -> int:
    """G: entries of ``score`` and ``sums`` for a number of colours."""
    return 3 * colors + 2 * 3 * SHARED


@njit(**KERNEL)
def start_tape(tape):
    """Before each path."""
    tape.score[:] = 0.0
    tape.drift[:] = 0.0


@njit(**KERNEL)
def tape_light(tape, r, g, b):
    """Light (r, g, b) arrives along the path that was scattered so far."""
    score, drift, sums = tape.score, tape.drift, tape.sums
    shared = len(score) - 3 * len(drift)
    for k in range(0, shared, 3):
        sums[k] += r * score[k]
        sums[k + 1] += g * score[k + 1]
        sums[k + 2] += b * score[k + 2]
    for j in range(len(drift)):
        k = shared + 3 * j
        sums[k] += r * (score[k] + drift[j])
        sums[k + 1] += g * (score[k + 1] + drift[j])
        sums[k + 2] += b * (score[k + 2] + drift[j])


@njit(**KERNEL)
def tape_direct(tape, row, p, prepared, slopes, sin_ti, cos_ti, phi, r, g, b):
    """Light (r, g, b) came from a lamp by way of fiber material ``row``: what that scattered has derivatives too."""
    color, system = tape.owners[row, COLOR], tape.owners[row, SYSTEM]
    if color < 0:
        return
    value, d = eval_fiber_slopes(p, load_slopes(tape.slopes, row), prepared, slopes, sin_ti, cos_ti, phi)
    r, g, b = r / max(value[0], 1e-300), g / max(value[1], 1e-300), b / max(value[2], 1e-300)
    sums, k = tape.sums, 3 * color
    sums[k] += r * d[0]
    sums[k + 1] += g * d[1]
    sums[k + 2] += b * d[2]
    k = len(sums) - 3 * SHARED * (2 - system)
    for j in range(3, 3 + 3 * SHARED, 3):
        sums[k] += r * d[j]
        sums[k + 1] += g * d[j + 1]
        sums[k + 2] += b * d[j + 2]
        k += 3


@njit(**KERNEL)
def tape_scatter(tape, row, p, prepared, slopes, u0, sin_ti, cos_ti, phi):
    """The path goes on in a direction that ``sample_fiber_lobe`` drew, weighed as that weighs it."""
    score, drift = tape.score, tape.drift
    if tape.keep != 1.0:
        for j in range(len(drift)):
            drift[j] *= tape.keep
    color, system = tape.owners[row, COLOR], tape.owners[row, SYSTEM]
    if color < 0:
        return
    a, d = lobe_slopes(p, load_slopes(tape.slopes, row), prepared, slopes, u0, sin_ti, cos_ti, phi)
    k = 3 * color
    for channel in range(3):
        score[k + channel] += a[channel]
    k = len(score) - 3 * SHARED * (2 - system)
    for channel in range(3):
        score[k + 3 + channel] += a[3 + channel]  # gamma_N
        score[k + 9 + channel] += a[6 + channel]  # index
    k = SHARED * system
    for j in range(SHARED):
        drift[k + j] += d[j]
