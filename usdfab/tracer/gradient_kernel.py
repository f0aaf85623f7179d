"""The path tracer with derivatives: paths as ``kernel.render_tile`` takes them, with a tape."""

from __future__ import annotations

import numpy as np
from numba import njit

from usdfab.tracer.intrinsics import ENTRY, borrow, new_ray_buffer
from usdfab.tracer.kernel import trace_path
from usdfab.tracer.tape import SHARED, Tape
from usdfab.tracer.vertex import camera_sample, pixel_shift
from usdfab.tracer.world import borrowed


@njit(**ENTRY, nogil=True)
def gradient_tile(world, view, seed, window, samples, max_depth, slopes, owners, keep, film, sums):
    """Add samples and their derivatives to the pixels of ``window`` (x0, y0, x1, y1).

    Parameters
    ----------
    slopes, owners, keep:
        See ``tape.Tape``.
    film: (y1 - y0, x1 - x0, CHANNELS)
        Sums over samples, see ``film.py``.
    sums: (y1 - y0, x1 - x0, G)
        Sums over samples of the derivatives, in the tape's layout.
    """
    memory = new_ray_buffer(world.embree[2])
    buffer = (borrow(memory[0]), borrow(memory[1]), memory[2])
    world = borrowed(world)
    own = np.zeros(sums.shape[2])
    fading = np.zeros(2 * SHARED)
    score, drift = borrow(own), borrow(fading)
    for row in range(window[1], window[3]):
        for column in range(window[0], window[2]):
            shift_x, shift_y = pixel_shift(seed, row * view.width + column)
            out = borrow(film[row - window[1], column - window[0]])
            pixel = borrow(sums[row - window[1], column - window[0]])
            tape = Tape(borrow(slopes), borrow(owners), score, drift, keep, pixel)
            for sample in range(samples):
                stream, time, ox, oy, oz, dx, dy, dz = camera_sample(view, seed, shift_x, shift_y, row, column, sample)
                trace_path(world, buffer, stream, time, ox, oy, oz, dx, dy, dz, max_depth, sample == 0, out, tape, None)
    # Numba frees an array after its last use: this is after the last path.
    memory[1][0] = np.uint32(0)
    own[0] = fading[0] = 0.0
