"""Sixteen rays at once through Embree, from compiled code.

A *packet* is (floats, words, address): one 64-byte aligned array that holds an RTCRayHit16, the lanes that are asked
for, and the arguments (``rtcore_ray.h`` and ``rtcore_common.h`` of Embree 4). Offsets are in 4-byte words.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import njit, types

from usdfab.neural.simd import LANES, intrinsic, load, spread, spread_integer, store, where
from usdfab.neural.simd_math import INLINE

ORIGIN, NEAR, DIRECTION, TIME, REACH, MASK, ID, FLAGS = (LANES * k for k in (0, 3, 4, 7, 8, 9, 10, 11))
U, V, PRIM, GEOMETRY, INSTANCE = (LANES * k for k in (15, 16, 17, 18, 19))
_VALID, _ARGUMENTS = LANES * 21, LANES * 22
_WORDS = LANES * 23
_COHERENT = 1 << 16


@intrinsic
def _call(typingctx, function, valid, scene, rays, arguments):
    """``function(valid, scene, rays, arguments)``, all given as addresses."""

    def codegen(context, builder, sig, args):
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), 4 * [pointer])
        callee = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(callee, [builder.inttoptr(a, pointer) for a in args[1:]])
        return context.get_dummy_value()

    return types.void(*(5 * [types.uint64])), codegen


@njit(cache=True)
def new_packet():
    """A packet for each thread at work."""
    memory = np.zeros(_WORDS + 16, dtype=np.float32)
    shift = ((64 - (memory.ctypes.data % 64)) % 64) // 4
    floats = memory[shift : shift + _WORDS]
    words = floats.view(np.int32)
    words[_ARGUMENTS], words[_ARGUMENTS + 1] = _COHERENT, -1
    for k in range(LANES):
        words[MASK + k] = -1
    return floats, words, np.uint64(floats.ctypes.data)


@njit(**INLINE)
def _rays(packet, mask, ox, oy, oz, dx, dy, dz, near, reach):
    floats, words, _address = packet
    store(floats, ORIGIN, ox)
    store(floats, ORIGIN + LANES, oy)
    store(floats, ORIGIN + 2 * LANES, oz)
    store(floats, NEAR, near)
    store(floats, DIRECTION, dx)
    store(floats, DIRECTION + LANES, dy)
    store(floats, DIRECTION + 2 * LANES, dz)
    store(floats, REACH, reach)
    store(words, _VALID, where(mask, spread_integer(-1), spread_integer(0)))


@njit(**INLINE)
def intersect_packet(function, scene, packet, mask, ox, oy, oz, dx, dy, dz, near):
    """Nearest hits of the lanes of a mask, as a mask; REACH, U, V, PRIM, INSTANCE (-1: none) are in the packet."""
    words, address = packet[1], packet[2]
    _rays(packet, mask, ox, oy, oz, dx, dy, dz, near, spread(1e30))
    store(words, GEOMETRY, spread_integer(-1))
    store(words, INSTANCE, spread_integer(-1))
    _call(function, address + np.uint64(4 * _VALID), scene, address, address + np.uint64(4 * _ARGUMENTS))
    return mask & (load(words, GEOMETRY) >= 0)


@njit(**INLINE)
def occluded_packet(function, scene, packet, mask, ox, oy, oz, dx, dy, dz, near, reach):
    """The lanes of a mask on whose ray something lies before ``reach``."""
    floats, _words, address = packet
    _rays(packet, mask, ox, oy, oz, dx, dy, dz, near, reach)
    _call(function, address + np.uint64(4 * _VALID), scene, address, address + np.uint64(4 * _ARGUMENTS))
    return mask & (load(floats, REACH) < 0.0)
