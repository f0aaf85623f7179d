"""Decoders in compiled loops over blocks of queries, without torch.

A block's numbers lie as rows of ``LANES`` queries in one array, so that every loop runs over queries. A network is a
table of layers on these rows, see ``decoder.Plan``; all numbers of inputs and outputs are multiples of 4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from usdfab.neural.encoding import BLOBS, LARGEST
from usdfab.neural.lean_network import FEATURES, LEVEL_BIAS, SIDES
from usdfab.neural.network import SLOPE

LANES = 256
"""Queries of a block: long enough to pay for the loops' starts, short enough for a core's own cache."""

IN_ROW, INPUTS, OUT_ROW, OUTPUTS, WEIGHTS, BIASES, ADD, ACTIVATE = range(8)
"""Columns of the table of layers: rows read and written, where the matrix (OUTPUTS, INPUTS) and the biases start,
whether to add to what is in the rows, whether a leaky rectifier follows."""

LEAN, PAPER = 0, 1

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}
_SLOPE = np.float32(SLOPE)
_FINEST, _LAST = np.float32(SIDES[0]), len(SIDES) - 1
_BIAS = np.float32(LEVEL_BIAS)
_LARGEST = np.float32(LARGEST)


@njit(**_OPTIONS)
def _layer(x, weights, biases, layer):
    """One layer of the table on all queries of a block: four inputs to four outputs at a time, in registers."""
    first, inputs, start, outputs = layer[IN_ROW], layer[INPUTS], layer[OUT_ROW], layer[OUTPUTS]
    for o in range(0, outputs, 4):
        r = start + o
        b = layer[BIASES] + o
        b0, b1, b2, b3 = biases[b], biases[b + 1], biases[b + 2], biases[b + 3]
        if layer[ADD]:
            for k in range(LANES):
                x[r, k] += b0
                x[r + 1, k] += b1
                x[r + 2, k] += b2
                x[r + 3, k] += b3
        else:
            for k in range(LANES):
                x[r, k] = b0
                x[r + 1, k] = b1
                x[r + 2, k] = b2
                x[r + 3, k] = b3
        for i in range(0, inputs, 4):
            w = layer[WEIGHTS] + o * inputs + i
            w00, w01, w02, w03 = weights[w], weights[w + 1], weights[w + 2], weights[w + 3]
            w += inputs
            w10, w11, w12, w13 = weights[w], weights[w + 1], weights[w + 2], weights[w + 3]
            w += inputs
            w20, w21, w22, w23 = weights[w], weights[w + 1], weights[w + 2], weights[w + 3]
            w += inputs
            w30, w31, w32, w33 = weights[w], weights[w + 1], weights[w + 2], weights[w + 3]
            q = first + i
            for k in range(LANES):
                a, b_, c, d = x[q, k], x[q + 1, k], x[q + 2, k], x[q + 3, k]
                x[r, k] += w00 * a + w01 * b_ + w02 * c + w03 * d
                x[r + 1, k] += w10 * a + w11 * b_ + w12 * c + w13 * d
                x[r + 2, k] += w20 * a + w21 * b_ + w22 * c + w23 * d
                x[r + 3, k] += w30 * a + w31 * b_ + w32 * c + w33 * d
        if layer[ACTIVATE]:
            for row in range(r, r + 4):
                for k in range(LANES):
                    x[row, k] = max(x[row, k], _SLOPE * x[row, k])


@njit(**_OPTIONS)
def _lean_inputs(x, found, code, queries, start, count):
    """Rows 0 to 15: features of the pyramid; 16 to 23: directions and half vector (``encoding.angles``)."""
    for k in range(count):
        u, v, size = queries[start + k, 0], queries[start + k, 1], queries[start + k, 2]
        level = math.log2(max(size, np.float32(1e-6)) * _FINEST) - _BIAS
        level = min(max(level, np.float32(0.0)), np.float32(_LAST))
        lower = min(int(level), _LAST - 1)
        between = np.float32(level - lower)
        for channel in range(FEATURES):
            found[channel] = np.float32(0.0)
        for step in range(2):
            share = between if step == 1 else np.float32(1.0) - between
            number = lower + step
            side = SIDES[0] >> number
            first = 4 * (SIDES[0] * SIDES[0] - side * side) // 3  # texels of the levels before
            px, py = u * np.float32(side) - np.float32(0.5), v * np.float32(side) - np.float32(0.5)
            left, low = math.floor(px), math.floor(py)
            fx, fy = np.float32(px - left), np.float32(py - low)
            c0, r0 = int(left) & (side - 1), int(low) & (side - 1)
            c1, r1 = (c0 + 1) & (side - 1), (r0 + 1) & (side - 1)
            a, b = first + r0 * side, first + r1 * side
            gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
            s0, s1, s2, s3 = share * gx * gy, share * fx * gy, share * gx * fy, share * fx * fy
            for channel in range(FEATURES):
                low_pair = s0 * code[a + c0, channel] + s1 * code[a + c1, channel]
                found[channel] += low_pair + s2 * code[b + c0, channel] + s3 * code[b + c1, channel]
        for channel in range(FEATURES):
            x[channel, k] = found[channel]
    for k in range(count):
        q = start + k
        ix, iy, iz, ox, oy = queries[q, 3], queries[q, 4], queries[q, 5], queries[q, 6], queries[q, 7]
        oz = math.sqrt(max(np.float32(1.0) - ox * ox - oy * oy, np.float32(0.0)))
        hx, hy, hz = ix + ox, iy + oy, iz + oz
        norm = np.float32(1.0 / max(math.sqrt(hx * hx + hy * hy + hz * hz), 1e-6))
        x[16, k], x[17, k], x[18, k], x[19, k], x[20, k] = ix, iy, iz, ox, oy
        x[21, k], x[22, k], x[23, k] = hx * norm, hy * norm, hz * norm


@njit(**_OPTIONS)
def _paper_inputs(x, angle_row, queries, start, count):
    """Rows 0 to 23: one-blobs of the footprint (``encoding.encoded_footprint``); from ``angle_row`` on directions."""
    for k in range(count):
        q = start + k
        size = math.sqrt(min(max(queries[q, 2], np.float32(0.0)), _LARGEST) / _LARGEST)
        for blob in range(BLOBS):
            middle = np.float32((blob + 0.5) / BLOBS)
            for part in range(3):
                away = (size if part == 2 else queries[q, part]) - middle
                if part < 2:
                    away -= np.float32(round(away))
                away *= np.float32(BLOBS)
                x[part * BLOBS + blob, k] = math.exp(np.float32(-0.5) * away * away)
        for column in range(5):
            x[angle_row + column, k] = queries[q, 3 + column]


@njit(**_OPTIONS)
def decode_range(architecture, layers, weights, biases, code, rows, angle_row, curvature, queries, first, last, out):
    """Components of queries ``first`` to ``last`` into ``out`` (N, 4) float32; none below 0."""
    x = np.zeros((rows, LANES), dtype=np.float32)
    found = np.zeros(FEATURES, dtype=np.float32)
    result = layers[-1, OUT_ROW]
    scale = np.float32(1.0 / curvature)
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        if architecture == LEAN:
            _lean_inputs(x, found, code, queries, start, count)
        else:
            _paper_inputs(x, angle_row, queries, start, count)
        for number in range(len(layers)):
            _layer(x, weights, biases, layers[number])
        for k in range(count):
            for column in range(2):
                out[start + k, column] = max(x[result + column, k], np.float32(0.0))
                value = x[result + 2 + column, k]
                out[start + k, 2 + column] = (
                    (math.exp(value) - np.float32(1.0)) * scale if value > np.float32(0.0) else np.float32(0.0)
                )
