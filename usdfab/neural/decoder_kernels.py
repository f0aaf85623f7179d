"""Decoders in compiled loops over blocks of queries, without torch.

A block's numbers lie as rows of ``BLOCK`` queries in one array, and vectors run over queries. A network is a table of
layers on these rows, see ``decoder.Plan``; all numbers of inputs and outputs are multiples of 4.

Queries are columns too, (8, N) in a flat array: row r of query q at ``r * stride + q``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from usdfab.neural.encoding import BLOBS, LARGEST
from usdfab.neural.lean_network import FEATURES, LEVEL_BIAS, SIDES
from usdfab.neural.network import SLOPE
from usdfab.neural.simd import (
    LANES,
    floor,
    gather,
    least,
    load,
    most,
    root,
    spread,
    spread_integer,
    store,
    to_floats,
    to_integers,
    transpose,
    where,
)
from usdfab.neural.simd_math import INLINE, dot, exp, log2

BLOCK = 2 * LANES
"""Queries of a block: two vectors, so that each weight that is read is used twice."""

IN_ROW, INPUTS, OUT_ROW, OUTPUTS, WEIGHTS, BIASES, ADD, ACTIVATE = range(8)
"""Columns of the table of layers: rows read and written, where the matrix and the biases start, whether to add to what
is in the rows, whether a leaky rectifier follows. Matrices are (OUTPUTS / 4, INPUTS, 4): four outputs at a time."""

LEAN, PAPER = 0, 1

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}
_LAST = len(SIDES) - 1


@njit(**INLINE)
def _rectified(x):
    return most(x, x * SLOPE)


@njit(**INLINE)
def _layer(x, weights, biases, first, inputs, start, outputs, w, b, add, activate):
    """One layer of the table on all queries of a block: four outputs of two vectors at a time, in registers."""
    for r in range(start * BLOCK, (start + outputs) * BLOCK, 4 * BLOCK):
        a0 = a1 = spread(biases[b])
        b0 = b1 = spread(biases[b + 1])
        c0 = c1 = spread(biases[b + 2])
        d0 = d1 = spread(biases[b + 3])
        b += 4
        if add:
            a0, a1 = a0 + load(x, r), a1 + load(x, r + LANES)
            b0, b1 = b0 + load(x, r + BLOCK), b1 + load(x, r + BLOCK + LANES)
            c0, c1 = c0 + load(x, r + 2 * BLOCK), c1 + load(x, r + 2 * BLOCK + LANES)
            d0, d1 = d0 + load(x, r + 3 * BLOCK), d1 + load(x, r + 3 * BLOCK + LANES)
        for q in range(first * BLOCK, (first + inputs) * BLOCK, BLOCK):
            x0, x1 = load(x, q), load(x, q + LANES)
            k = weights[w]
            a0, a1 = a0 + x0 * k, a1 + x1 * k
            k = weights[w + 1]
            b0, b1 = b0 + x0 * k, b1 + x1 * k
            k = weights[w + 2]
            c0, c1 = c0 + x0 * k, c1 + x1 * k
            k = weights[w + 3]
            d0, d1 = d0 + x0 * k, d1 + x1 * k
            w += 4
        if activate:
            a0, a1, b0, b1 = _rectified(a0), _rectified(a1), _rectified(b0), _rectified(b1)
            c0, c1, d0, d1 = _rectified(c0), _rectified(c1), _rectified(d0), _rectified(d1)
        store(x, r, a0)
        store(x, r + LANES, a1)
        store(x, r + BLOCK, b0)
        store(x, r + BLOCK + LANES, b1)
        store(x, r + 2 * BLOCK, c0)
        store(x, r + 2 * BLOCK + LANES, c1)
        store(x, r + 3 * BLOCK, d0)
        store(x, r + 3 * BLOCK + LANES, d1)


@njit(**INLINE)
def _corner(texels, shares, slot, level, u, v, share):
    """The four texels about a footprint's place on a level (``lean_network._corners``), and what each counts."""
    side = spread_integer(SIDES[0]) >> level
    first = to_integers((to_floats(spread_integer(SIDES[0] ** 2) - side * side)) * (4.0 / 3.0) + 0.5)
    px, py = u * to_floats(side) - 0.5, v * to_floats(side) - 0.5
    left, low = floor(px), floor(py)
    fx, fy = px - left, py - low
    c0, r0 = to_integers(left) & (side - 1), to_integers(low) & (side - 1)
    c1, r1 = (c0 + 1) & (side - 1), (r0 + 1) & (side - 1)
    a, b = first + r0 * side, first + r1 * side
    gx, gy = share * (1.0 - fx), 1.0 - fy
    fx = share * fx
    store(texels, slot, (a + c0) * FEATURES)
    store(texels, slot + LANES, (a + c1) * FEATURES)
    store(texels, slot + 2 * LANES, (b + c0) * FEATURES)
    store(texels, slot + 3 * LANES, (b + c1) * FEATURES)
    store(shares, slot, gx * gy)
    store(shares, slot + LANES, fx * gy)
    store(shares, slot + 2 * LANES, gx * fy)
    store(shares, slot + 3 * LANES, fx * fy)


@njit(**INLINE)
def _lean_inputs(x, half, found, texels, shares, code, u, v, size, ix, iy, iz, ox, oy):
    """Rows 0 to 15: features of the pyramid; 16 to 23: directions and half vector (``encoding.angles``)."""
    level = least(most(log2(most(size, 1e-6) * SIDES[0]) - LEVEL_BIAS, 0.0), float(_LAST))
    lower = least(floor(level), _LAST - 1.0)
    between, number = level - lower, to_integers(lower)
    _corner(texels, shares, 0, number, u, v, 1.0 - between)
    _corner(texels, shares, 4 * LANES, number + 1, u, v, between)
    for lane in range(LANES):
        total = load(code, texels[lane]) * shares[lane]
        for k in range(LANES + lane, 8 * LANES, LANES):
            total = total + load(code, texels[k]) * shares[k]
        store(found, lane * FEATURES, total)
    transpose(found, 0, x, half, BLOCK)
    oz = root(most(1.0 - ox * ox - oy * oy, 0.0))
    hx, hy, hz = ix + ox, iy + oy, iz + oz
    norm = 1.0 / most(root(dot(hx, hy, hz, hx, hy, hz)), 1e-6)
    row = FEATURES * BLOCK + half
    store(x, row, ix)
    store(x, row + BLOCK, iy)
    store(x, row + 2 * BLOCK, iz)
    store(x, row + 3 * BLOCK, ox)
    store(x, row + 4 * BLOCK, oy)
    store(x, row + 5 * BLOCK, hx * norm)
    store(x, row + 6 * BLOCK, hy * norm)
    store(x, row + 7 * BLOCK, hz * norm)


@njit(**INLINE)
def _paper_inputs(x, half, angle_row, u, v, size, ix, iy, iz, ox, oy):
    """Rows 0 to 23: one-blobs of the footprint (``encoding.encoded_footprint``); from ``angle_row`` on directions."""
    side = root(least(most(size, 0.0), LARGEST) * (1.0 / LARGEST))
    for blob in range(BLOBS):
        middle = (blob + 0.5) / BLOBS
        for part in range(3):
            away = side - middle
            if part < 2:
                away = (u if part == 0 else v) - middle
                away = away - floor(away + 0.5)
            away = away * float(BLOBS)
            store(x, (part * BLOBS + blob) * BLOCK + half, exp(away * away * -0.5))
    row = angle_row * BLOCK + half
    store(x, row, ix)
    store(x, row + BLOCK, iy)
    store(x, row + 2 * BLOCK, iz)
    store(x, row + 3 * BLOCK, ox)
    store(x, row + 4 * BLOCK, oy)


@njit(**OPTIONS)
def decode_range(
    architecture,
    layers,
    weights,
    biases,
    code,
    rows,
    angle_row,
    linear,
    curvature,
    queries,
    stride,
    order,
    first,
    last,
    out,
):
    """Components of queries ``order[first:last]`` into rows ``first`` to ``last`` of ``out`` (N, 4) float32, none < 0.

    Parameters
    ----------
    linear:
        How many of the four results are taken as they are; the others go through g^-1.
    queries: (8 stride,) float32
        In columns.
    order: (N,) int32
        Which are asked.
    """
    x = np.zeros(rows * BLOCK, dtype=np.float32)
    found = np.zeros(LANES * FEATURES, dtype=np.float32)
    texels, shares = np.zeros(8 * LANES, dtype=np.int32), np.zeros(8 * LANES, dtype=np.float32)
    block = np.zeros(BLOCK, dtype=np.int32)
    result = layers[-1, OUT_ROW] * BLOCK
    scale = 1.0 / curvature
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for k in range(BLOCK):
            block[k] = order[start + min(k, count - 1)]
        for half in range(0, BLOCK, LANES):
            q = load(block, half)
            u, v, size = gather(queries, q), gather(queries, q + stride), gather(queries, q + 2 * stride)
            ix, iy = gather(queries, q + 3 * stride), gather(queries, q + 4 * stride)
            iz, ox = gather(queries, q + 5 * stride), gather(queries, q + 6 * stride)
            oy = gather(queries, q + 7 * stride)
            if architecture == LEAN:
                _lean_inputs(x, half, found, texels, shares, code, u, v, size, ix, iy, iz, ox, oy)
            else:
                _paper_inputs(x, half, angle_row, u, v, size, ix, iy, iz, ox, oy)
        for n in range(len(layers)):
            _layer(
                x, weights, biases, layers[n, IN_ROW], layers[n, INPUTS], layers[n, OUT_ROW], layers[n, OUTPUTS],
                layers[n, WEIGHTS], layers[n, BIASES], layers[n, ADD] != 0, layers[n, ACTIVATE] != 0,
            )  # fmt: skip
        compressed = result + linear * BLOCK
        for r in range(result, compressed, LANES):
            store(x, r, most(load(x, r), 0.0))
        for r in range(compressed, result + 4 * BLOCK, LANES):
            value = load(x, r)
            store(x, r, where(value > 0.0, (exp(value) - 1.0) * scale, 0.0))
        for k in range(count):
            for column in range(4):
                out[start + k, column] = x[result + column * BLOCK + k]
