"""The compiled driver: strips of pixels from rays to light, without a step of Python in between."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.neural.decoder_kernels import decode_range
from usdfab.neural.gbuffer import OPTIONS, SIDE, fill
from usdfab.neural.lighting import add_answers, light_pixels, sort_pixels
from usdfab.neural.packets import new_packet
from usdfab.neural.simd import LANES
from usdfab.tracer.intrinsics import new_ray_buffer
from usdfab.tracer.world import borrowed


class Decoders(NamedTuple):
    """The plans of all materials, one after the other.

    Parameters
    ----------
    table: (materials, 7) int64
        Architecture, first and last row in ``layers``, rows of a block, row of the directions, first of ``codes``, how
        many results are taken as they are.
    curvatures: (materials,)
    layers, weights, biases, codes:
        See ``decoder.Plan``; places in ``weights`` and ``biases`` count from their start here.
    """

    table: NDArray[np.int64]
    curvatures: NDArray[np.float64]
    layers: NDArray[np.int64]
    weights: NDArray[np.float32]
    biases: NDArray[np.float32]
    codes: NDArray[np.float32]


def pixels_of(window: tuple[int, int, int, int]) -> int:
    """Places in the buffers for a window (x0, y0, x1, y1): whole tiles."""
    x0, y0, x1, y1 = window
    return -(-(x1 - x0) // SIDE) * -(-(y1 - y0) // SIDE) * LANES


@njit(**OPTIONS)
def see_strip(world, cloth, view, jitter, shrink, x0, x1, y0, y1, tags, numbers, radiance):
    """``gbuffer.fill`` of one strip."""
    world = borrowed(world)
    packet, buffer = new_packet(), new_ray_buffer(world.embree[2])
    fill(world, cloth, view, jitter[0], jitter[1], shrink, x0, x1, y0, y1, packet, buffer, tags, numbers, radiance)


@njit(**OPTIONS)
def light_strip(world, cloth, lights, u1, u2, share, tags, numbers, group, queries, weights, radiance):
    """``lighting.light_pixels`` of one strip."""
    world = borrowed(world)
    packet, buffer = new_packet(), new_ray_buffer(world.embree[2])
    light_pixels(
        world, cloth, lights, u1, u2, share, packet, buffer, len(group), tags, numbers, group, queries, weights,
        radiance,
    )  # fmt: skip


@njit(**OPTIONS)
def decode_group(decoders, number, queries, stride, order, first, last, out):
    """Answers of material ``number`` to the queries ``order[first:last]``, into the same rows of ``out``."""
    row = decoders.table[number]
    decode_range(
        row[0], decoders.layers[row[1] : row[2]], decoders.weights, decoders.biases, decoders.codes[row[5] :], row[3],
        row[4], row[6], decoders.curvatures[number], queries, stride, order, first, last, out,
    )  # fmt: skip


@njit(**OPTIONS)
def answer_strip(decoders, albedo, tinted, count, numbers, group, queries, weights, starts, order, answers, radiance):
    """Ask the decoders what ``light_pixels`` prepared, and add the light; returns how many queries there were."""
    sort_pixels(group, starts, order)
    for number in range(len(starts) - 1):
        first, last = starts[number], starts[number + 1]
        if last > first:
            decode_group(decoders, number, queries, count, order, first, last, answers)
            add_answers(
                order, first, last, answers, albedo[number // 4, number % 2], tinted[number // 4], weights, numbers,
                count, radiance,
            )  # fmt: skip
    return starts[-1]


@njit(**OPTIONS)
def put_strip(radiance, x0, x1, y0, y1, gain, picture, left, top):
    """Add pixels in tiles to rows of a picture (H, W, 3) whose corner is at (left, top)."""
    across = (x1 - x0 + SIDE - 1) // SIDE
    count = len(radiance) // 3
    for y in range(y0, y1):
        for x in range(x0, x1):
            p = ((y - y0) // SIDE * across + (x - x0) // SIDE) * LANES + (y - y0) % SIDE * SIDE + (x - x0) % SIDE
            for c in range(3):
                picture[y - top, x - left, c] += gain * radiance[c * count + p]
