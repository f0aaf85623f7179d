"""Tangents of fibers at their vertices, in four bytes each.

A unit vector is projected onto an octahedron, whose lower half is folded out into a square (Meyer et al. 2010, "On
Floating-Point Normal Vectors"): two numbers of 16 bits, errors below 7e-5 rad.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.tracer.intrinsics import KERNEL, float_at, word_at

_SCALE = 32767.0


def pack_tangents(tangents: NDArray) -> NDArray[np.uint32]:
    """(V,) unit vectors (V, 3), the first number in the lower 16 bits."""
    t = np.asarray(tangents, dtype=float)
    t = t / np.abs(t).sum(axis=1, keepdims=True)
    signs = np.where(t[:, :2] < 0.0, -1.0, 1.0)
    square = np.where(t[:, 2:] < 0.0, (1.0 - np.abs(t[:, 1::-1])) * signs, t[:, :2])
    return np.rint(_SCALE * square).astype("<i2").view("<u4").reshape(-1)


def unpack_tangents(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """(V, 3) unit vectors from ``pack_tangents``."""
    square = np.ascontiguousarray(packed, dtype="<u4").view("<i2").reshape(-1, 2) / _SCALE
    z = 1.0 - np.abs(square).sum(axis=1)
    flat = square - np.where(square < 0.0, -1.0, 1.0) * np.maximum(-z, 0.0)[:, None]
    t = np.c_[flat, z]
    return t / np.linalg.norm(t, axis=1, keepdims=True)


@njit(**KERNEL, forceinline=True)
def _unpack(word):
    """Unit vector in the bits of an int64 below 2^32."""
    x = np.float64(np.int16(word & 0xFFFF)) / _SCALE
    y = np.float64(np.int16((word >> 16) & 0xFFFF)) / _SCALE
    z = 1.0 - abs(x) - abs(y)
    fold = max(-z, 0.0)
    x, y = x - math.copysign(fold, x), y - math.copysign(fold, y)
    norm = 1.0 / math.sqrt(x * x + y * y + z * z)
    return norm * x, norm * y, norm * z


@njit(**KERNEL, forceinline=True)
def radius_at(records, patch, prim):
    """Radius of the fiber that a segment belongs to, patch units."""
    return np.float64(float_at(records[patch, 2], 4 * np.int64(word_at(records[patch, 1], 2 * prim)) + 3))


@njit(**KERNEL, forceinline=True)
def tangent_at(records, patch, prim, s):
    """Where a ray met a fiber: (curve of the patch, tangent (3), not normalised).

    Parameters
    ----------
    records: (P, 2) uint64
        Addresses of the patches' tangents and segments (``Patches``).
    prim, s:
        Segment, and place along it. Range: [0, 1].
    """
    tangents, segments = records[patch, 0], records[patch, 1]
    first, curve = np.int64(word_at(segments, 2 * prim)), np.int64(word_at(segments, 2 * prim + 1))
    ax, ay, az = _unpack(np.int64(word_at(tangents, first)))
    bx, by, bz = _unpack(np.int64(word_at(tangents, first + 1)))
    r = 1.0 - s
    return curve, r * ax + s * bx, r * ay + s * by, r * az + s * bz
