"""Sixteen numbers as one in compiled code: vectors of floats, of whole numbers and of truth values for Numba.

Kernels are written as for one pixel and work on sixteen; LLVM cuts the vectors to the processor's own (AVX-512, AVX2,
NEON). ``+ - * /`` and comparisons work between vectors and with plain numbers (as singles); ``& | ^ << >>`` on whole
numbers and ``& | ~`` on truth values. All arrays are one-dimensional and contiguous; indices are not checked.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as numba_intrinsic, lower_builtin, models, register_model

LANES = 16
"""Numbers in a vector."""

_FLAGS = ("contract", "nsz", "arcp", "reassoc")
_I32, _F32, _BIT = ir.IntType(32), ir.FloatType(), ir.IntType(1)


def intrinsic(maker: Any) -> Any:
    """Numba's, of any type to type checkers: they see one argument too many."""
    return numba_intrinsic(maker)


class Vector(types.Type):
    """``LANES`` numbers of one kind."""

    def __init__(self, name: str, element: Any) -> None:
        super().__init__(name=f"{name}x{LANES}")
        self.llvm = ir.VectorType(element, LANES)


FLOATS, INTEGERS, BITS = Vector("float", _F32), Vector("integer", _I32), Vector("bit", _BIT)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, kind.llvm)


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    empty = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(empty, value, _I32(0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _as_vector(context: Any, builder: Any, value: Any, source: Any, target: Vector) -> Any:
    """A vector as it is; a plain number in every lane."""
    if isinstance(source, Vector):
        return value
    scalar = context.cast(builder, value, source, types.float32 if target is FLOATS else types.int32)
    return _spread(builder, scalar, target.llvm)


def _operate(function: Any, kinds: tuple[Vector, ...], result: Any, make: Any) -> None:
    """Teach Numba an operator between vectors of a kind, and with numbers on one side."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) != 2 or not any(isinstance(a, Vector) for a in args):
                return None
            kind = next(a for a in args if isinstance(a, Vector))
            if kind not in kinds or not all(a is kind or isinstance(a, types.Number | types.Literal) for a in args):
                return None
            return signature(result or kind, *args)

    infer_global(function)(Template)
    for kind in kinds:
        for left, right in ((kind, kind), (kind, types.Any), (types.Any, kind)):

            @lower_builtin(function, left, right)
            def lower(context: Any, builder: Any, sig: Any, args: Any, kind: Vector = kind) -> Any:
                a, b = (_as_vector(context, builder, v, s, kind) for v, s in zip(args, sig.args, strict=True))
                return make(builder, a, b, kind)


def _arithmetic(name: str) -> Any:
    def make(builder: Any, a: Any, b: Any, kind: Vector) -> Any:
        if kind is FLOATS:
            return getattr(builder, "f" + name)(a, b, flags=_FLAGS)
        return getattr(builder, name)(a, b)

    return make


def _comparison(sign: str) -> Any:
    def make(builder: Any, a: Any, b: Any, kind: Vector) -> Any:
        return builder.fcmp_ordered(sign, a, b) if kind is FLOATS else builder.icmp_signed(sign, a, b)

    return make


for _function, _name in ((operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul")):
    _operate(_function, (FLOATS, INTEGERS), None, _arithmetic(_name))
_operate(operator.truediv, (FLOATS,), None, _arithmetic("div"))
for _function, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
):  # fmt: skip
    _operate(_function, (FLOATS, INTEGERS), BITS, _comparison(_sign))
_operate(operator.and_, (INTEGERS, BITS), None, lambda builder, a, b, kind: builder.and_(a, b))
_operate(operator.or_, (INTEGERS, BITS), None, lambda builder, a, b, kind: builder.or_(a, b))
_operate(operator.xor, (INTEGERS, BITS), None, lambda builder, a, b, kind: builder.xor(a, b))
_operate(operator.lshift, (INTEGERS,), None, lambda builder, a, b, kind: builder.shl(a, b))
_operate(operator.rshift, (INTEGERS,), None, lambda builder, a, b, kind: builder.ashr(a, b))


def _called(builder: Any, name: str, kind: Any, values: list[Any], fastmath: tuple[str, ...] = _FLAGS) -> Any:
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [v.type for v in values]), name
    )  # fmt: skip
    return builder.call(function, values, fastmath=fastmath)


def _math(llvm_name: str, count: int) -> Any:
    """An intrinsic of LLVM on float vectors."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [_as_vector(context, builder, v, s, FLOATS) for v, s in zip(args, sig.args, strict=True)]
        return _called(builder, f"llvm.{llvm_name}.v{LANES}f32", FLOATS.llvm, values)

    def unary(typingctx: Any, a: Any) -> Any:
        return FLOATS(a), codegen

    def binary(typingctx: Any, a: Any, b: Any) -> Any:
        return FLOATS(a, b), codegen

    return intrinsic(unary if count == 1 else binary)


root, floor, size_of = _math("sqrt", 1), _math("floor", 1), _math("fabs", 1)
"""Square root, greatest whole number below, absolute value."""


def _extreme(sign: str) -> Any:
    def maker(typingctx: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            x, y = (_as_vector(context, builder, v, s, FLOATS) for v, s in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(sign, x, y), x, y)

        return FLOATS(a, b), codegen

    return intrinsic(maker)


least, most = _extreme("<"), _extreme(">")
"""The smaller, the greater of two; the second where one is no number."""


@intrinsic
def spread(typingctx, value):
    """A float in every lane."""

    def codegen(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0], FLOATS)

    return FLOATS(value), codegen


@intrinsic
def spread_integer(typingctx, value):
    """A whole number in every lane."""

    def codegen(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0], INTEGERS)

    return INTEGERS(value), codegen


@intrinsic
def lanes(typingctx):
    """0, 1, ... 15."""

    def codegen(context, builder, sig, args):
        return ir.Constant(INTEGERS.llvm, list(range(LANES)))

    return INTEGERS(), codegen


@intrinsic
def where(typingctx, mask, a, b):
    """``a`` where the mask is set, else ``b``; one of both at least is a vector."""
    kind = a if isinstance(a, Vector) else b

    def codegen(context, builder, sig, args):
        x, y = (_as_vector(context, builder, v, s, kind) for v, s in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], x, y)

    return kind(mask, a, b), codegen


@intrinsic
def invert(typingctx, mask):
    """The lanes that are not set."""

    def codegen(context, builder, sig, args):
        return builder.not_(args[0])

    return BITS(mask), codegen


@intrinsic
def bits_of(typingctx, mask):
    """The mask as a whole number, lane 0 the lowest bit."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.int64(mask), codegen


def _converted(target: Vector, how: str) -> Any:
    def maker(typingctx: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return getattr(builder, how)(args[0], target.llvm)

        return target(value), codegen

    return intrinsic(maker)


to_integers, to_floats = _converted(INTEGERS, "fptosi"), _converted(FLOATS, "sitofp")
"""Towards zero; exact up to 2^24."""

bits_to_integers, integers_to_bits = _converted(INTEGERS, "bitcast"), _converted(FLOATS, "bitcast")
"""The same 32 bits as the other kind."""


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any, index_kind: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [context.cast(builder, index, index_kind, types.int64)])


@intrinsic
def load(typingctx, array, index):
    """``array[index : index + 16]``, float32 or int32."""
    kind = FLOATS if array.dtype == types.float32 else INTEGERS

    def codegen(context, builder, sig, args):
        where = _address(context, builder, sig.args[0], args[0], args[1], sig.args[1])
        return builder.load(builder.bitcast(where, kind.llvm.as_pointer()), align=4)

    return kind(array, index), codegen


@intrinsic
def store(typingctx, array, index, value):
    """``array[index : index + 16] = value``."""

    def codegen(context, builder, sig, args):
        where = _address(context, builder, sig.args[0], args[0], args[1], sig.args[1])
        builder.store(args[2], builder.bitcast(where, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def gather(typingctx, array, indices):
    """``array[indices]`` for whole numbers, all within the array."""
    kind = FLOATS if array.dtype == types.float32 else INTEGERS

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        found = ir.Constant(kind.llvm, ir.Undefined)
        for lane in range(LANES):
            index = builder.zext(builder.extract_element(args[1], _I32(lane)), ir.IntType(64))
            found = builder.insert_element(found, builder.load(builder.gep(data, [index]), align=4), _I32(lane))
        return found

    return kind(array, indices), codegen


@intrinsic
def transpose(typingctx, source, first, target, start, step):
    """Rows of 16 floats, one after the other from ``source[first]``, as columns: k to ``target[start + k step]``."""

    def codegen(context, builder, sig, args):
        rows = []
        for k in range(LANES):
            at = builder.add(context.cast(builder, args[1], sig.args[1], types.int64), ir.IntType(64)(LANES * k))
            where = _address(context, builder, sig.args[0], args[0], at, types.int64)
            rows.append(builder.load(builder.bitcast(where, FLOATS.llvm.as_pointer()), align=4))
        apart = 1
        while apart < LANES:  # blocks of ``apart`` lanes change places between rows that are as far apart
            low = [k if not k & apart else LANES + k - apart for k in range(LANES)]
            high = [k + apart if not k & apart else LANES + k for k in range(LANES)]
            masks = [ir.Constant(ir.VectorType(_I32, LANES), order) for order in (low, high)]
            for k in range(LANES):
                if not k & apart:
                    a, b = rows[k], rows[k + apart]
                    rows[k], rows[k + apart] = (builder.shuffle_vector(a, b, mask) for mask in masks)
            apart *= 2
        begin, stride = (context.cast(builder, v, s, types.int64) for v, s in zip(args[3:], sig.args[3:], strict=True))
        for k, row in enumerate(rows):
            at = builder.add(begin, builder.mul(stride, ir.IntType(64)(k)))
            where = _address(context, builder, sig.args[2], args[2], at, types.int64)
            builder.store(row, builder.bitcast(where, FLOATS.llvm.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(source, first, target, start, step), codegen
