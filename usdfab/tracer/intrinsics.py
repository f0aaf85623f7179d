"""Calling Embree from Numba: functions by address, ray structures by layout.

A *ray buffer* is one float32 array that holds, 16-byte aligned, an RTCRayHit and two argument structures; its uint32
view has the integer fields. Offsets below are in 4-byte words.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.extending import intrinsic

# RTCRay, then RTCHit (rtcore_ray.h of Embree 4).
ORG, TNEAR, DIR, TIME, TFAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
NG, U, V, PRIM, GEOM, INST = 12, 15, 16, 17, 18, 19
# RTCIntersectArguments / RTCOccludedArguments, one with the back-face filter and one without (rtcore_common.h).
ARGS_FILTER, ARGS_PLAIN = 24, 36
WORDS = 48

KERNEL: dict[str, Any] = {
    "cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}, "_nrt": False
}  # fmt: skip
"""Options of what kernels call: divisions are not checked (what divides is guarded where it can be 0), NaN and infinity
keep their meaning, and references to arrays are not counted: a scene has two dozen arrays, and counting them at each
call takes 7 % of the tracer's time. So such a function can neither make an array nor return one that is not given."""
ENTRY = {**KERNEL, "_nrt": True}
"""Options of kernels that Python calls; they make arrays, and start threads."""
_INVALID = np.uint32(0xFFFFFFFF)
_INVOKE_ARGUMENT_FILTER = np.uint32(2)


@intrinsic
def _call_embree(typingctx, function, scene, ray, arguments):
    """``function(scene, ray, arguments)``, all given as addresses."""
    signature = types.void(types.uint64, types.uint64, types.uint64, types.uint64)

    def codegen(context, builder, signature, args):
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer])
        callee = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(callee, [builder.inttoptr(a, pointer) for a in args[1:]])
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _as_pointer(typingctx, address):
    """An address as a void pointer that ``carray`` takes."""
    signature = types.voidptr(types.uint64)

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return signature, codegen


def _load(kind, returned):
    def load(typingctx, address, index):
        def codegen(context, builder, signature, args):
            start = builder.inttoptr(args[0], kind.as_pointer())
            return builder.load(builder.gep(start, [args[1]]))

        return returned(types.uint64, types.int64), codegen

    return intrinsic(load)


word_at: Any = _load(ir.IntType(32), types.uint32)
"""``word_at(address, k)``: the k-th uint32 of the memory at an address; who calls it knows how many there are."""
float_at: Any = _load(ir.FloatType(), types.float32)
"""The same of float32."""


def _borrow(typingctx, array):
    signature = array(array)

    def codegen(context, builder, signature, args):
        view = context.make_array(signature.args[0])(context, builder, args[0])
        view.meminfo = ir.Constant(view.meminfo.type, None)
        view.parent = ir.Constant(view.parent.type, None)
        return view._getvalue()

    return signature, codegen


borrow: Any = intrinsic(_borrow)
"""The same array without its owner, so that kernels do not count references (atomic operations on shared memory).

The caller keeps the array alive.
"""


@cfunc(types.void(types.CPointer(types.uint64)), cache=True)
def reject_back_faces(arguments):
    """Embree filter: refuse hits on the inside of a fiber.

    This build of Embree does not cull back faces of curves. A ray that was transmitted starts on the surface and goes
    through the fiber; its far side must not stop it (the BSDF is the near-field model of the whole fiber).
    """
    fields = carray(arguments, 6)  # RTCFilterFunctionNArguments: valid, user, context, ray, hit, N
    ray = carray(_as_pointer(fields[3]), 12, dtype=np.float32)
    normal = carray(_as_pointer(fields[4]), 3, dtype=np.float32)
    if ray[DIR] * normal[0] + ray[DIR + 1] * normal[1] + ray[DIR + 2] * normal[2] > np.float32(0.0):
        valid = carray(_as_pointer(fields[0]), 1, dtype=np.int32)
        valid[0] = 0


def filter_address() -> int:
    """Address of ``reject_back_faces`` for the argument structure."""
    address = reject_back_faces.address
    assert address is not None
    return address


@njit(cache=True, inline="always")
def new_ray_buffer(filter_function):
    """A ray buffer: (float32 view, uint32 view, address). One for each thread at work."""
    memory = np.zeros(WORDS + 4, dtype=np.float32)
    shift = ((16 - (memory.ctypes.data % 16)) % 16) // 4
    floats = memory[shift : shift + WORDS]
    words = floats.view(np.uint32)
    for base in (ARGS_FILTER, ARGS_PLAIN):
        words[base + 1] = _INVALID  # feature mask: all
        words[base] = np.uint32(0)
    words[ARGS_FILTER] = _INVOKE_ARGUMENT_FILTER
    words[ARGS_FILTER + 4] = np.uint32(np.uint64(filter_function) & np.uint64(0xFFFFFFFF))
    words[ARGS_FILTER + 5] = np.uint32(np.uint64(filter_function) >> np.uint64(32))
    return floats, words, np.uint64(floats.ctypes.data)


@njit(cache=True, inline="always")
def intersect(function, scene, buffer, ox, oy, oz, dx, dy, dz, tnear, tfar, arguments, time=0.0):
    """Nearest hit along the ray. True on a hit; the hit's fields are in the buffer (TFAR, NG, U, V, PRIM)."""
    f, w, address = buffer
    f[ORG], f[ORG + 1], f[ORG + 2], f[TNEAR] = ox, oy, oz, tnear
    f[DIR], f[DIR + 1], f[DIR + 2], f[TIME] = dx, dy, dz, time
    f[TFAR] = tfar
    w[MASK], w[ID], w[FLAGS] = _INVALID, np.uint32(0), np.uint32(0)
    w[GEOM], w[INST] = _INVALID, _INVALID
    _call_embree(function, scene, address, address + np.uint64(4 * arguments))
    return w[GEOM] != _INVALID


@njit(cache=True, inline="always")
def occluded(function, scene, buffer, ox, oy, oz, dx, dy, dz, tnear, tfar, arguments, time=0.0):
    """Whether anything lies on the ray between tnear and tfar."""
    f, w, address = buffer
    f[ORG], f[ORG + 1], f[ORG + 2], f[TNEAR] = ox, oy, oz, tnear
    f[DIR], f[DIR + 1], f[DIR + 2], f[TIME] = dx, dy, dz, time
    f[TFAR] = tfar
    w[MASK], w[ID], w[FLAGS] = _INVALID, np.uint32(0), np.uint32(0)
    _call_embree(function, scene, address, address + np.uint64(4 * arguments))
    return f[TFAR] < 0.0
