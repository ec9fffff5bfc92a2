"""Eight float32 lanes as a value of their own inside compiled kernels.

Numba leaves vectorisation to LLVM's loop vectoriser, which gives up on the compositing loops as
soon as they carry state. Here a vector is a type: `Lanes` holds eight float32 numbers and `Mask`
eight truth values, so a kernel written with them is SIMD code by construction (one AVX register
each; LLVM splits them where a machine has narrower ones). Operations are never reordered, and
`fma` fuses on every machine that can, so the same expression in two kernels gives the same bits.

The functions below exist only inside compiled kernels; `Lanes` and `Mask` are their annotations.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model
from numpy.typing import NDArray

LANES = 8

_FLOAT = ir.FloatType()
_BYTE = ir.IntType(8)
_INT = ir.IntType(32)
_LONG = ir.IntType(64)
_LANES = ir.VectorType(_FLOAT, LANES)
_INT_LANES = ir.VectorType(_INT, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class Mask(Protocol):
    """Eight truth values."""

    def __and__(self, other: "Mask") -> "Mask": ...


class Lanes(Protocol):
    """Eight float32 numbers."""

    def __add__(self, other: "Lanes") -> "Lanes": ...
    def __sub__(self, other: "Lanes") -> "Lanes": ...
    def __mul__(self, other: "Lanes") -> "Lanes": ...
    def __truediv__(self, other: "Lanes") -> "Lanes": ...
    def __ge__(self, other: "Lanes") -> Mask: ...
    def __le__(self, other: "Lanes") -> Mask: ...
    def __lt__(self, other: "Lanes") -> Mask: ...
    def __gt__(self, other: "Lanes") -> Mask: ...


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Mask")


_lanes = _LanesType()
_mask = _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _LANES)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _MASK)


def _llvm(builder: Any, name: str, result: ir.Type, args: Sequence[Any]) -> Any:
    """Calls an LLVM intrinsic."""
    function = builder.module.globals.get(name)
    if function is None:
        signature = ir.FunctionType(result, [arg.type for arg in args])
        function = ir.Function(builder.module, signature, name)
    return builder.call(function, args)


def _repeat(constant: float, kind: ir.Type = _FLOAT) -> ir.Constant:
    return ir.Constant(ir.VectorType(kind, LANES), [constant] * LANES)


def _shuffle(builder: Any, a: Any, b: Any, order: Sequence[int]) -> Any:
    """Picks lanes of `a` (0 to 7) and `b` (8 to 15)."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(order)), list(order)))


def _splat(builder: Any, scalar: Any) -> Any:
    single = builder.insert_element(ir.Constant(_LANES, ir.Undefined), scalar, _INT(0))
    return _shuffle(builder, single, single, [0] * LANES)


def _define(sign: Any, operand: Any, result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Gives a Python operator its meaning between two vectors."""

    @intrinsic
    def implementation(typing_context: Any, a: Any, b: Any) -> Any:
        return result(a, b), lambda context, builder, signature, args: emit(builder, *args)

    @overload(sign, strict=False)
    def _overloaded(a: Any, b: Any) -> Any:
        if a == operand and b == operand:
            return lambda a, b: implementation(a, b)
        return None


_define(operator.add, _lanes, _lanes, lambda builder, a, b: builder.fadd(a, b))
_define(operator.sub, _lanes, _lanes, lambda builder, a, b: builder.fsub(a, b))
_define(operator.mul, _lanes, _lanes, lambda builder, a, b: builder.fmul(a, b))
_define(operator.truediv, _lanes, _lanes, lambda builder, a, b: builder.fdiv(a, b))
_define(operator.ge, _lanes, _mask, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define(operator.le, _lanes, _mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_define(operator.lt, _lanes, _mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_define(operator.gt, _lanes, _mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define(operator.and_, _mask, _mask, lambda builder, a, b: builder.and_(a, b))


@intrinsic
def splat(typing_context: Any, value: Any) -> Any:
    """Returns a float32 number in all eight lanes."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return _lanes(types.float32), emit


@intrinsic
def ramp(typing_context: Any) -> Any:
    """Returns (0, 1, ..., 7)."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_LANES, [float(lane) for lane in range(LANES)])

    return _lanes(), emit


def _lanes_pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _LANES.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """Returns the eight numbers of a contiguous float32 vector from `index` on."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _lanes_pointer(context, builder, signature.args[0], *args)
        return builder.load(pointer, align=4)

    return _lanes(array, types.intp), emit


@intrinsic
def broadcast(typing_context: Any, array: Any, index: Any) -> Any:
    """Returns one number of a contiguous float32 vector in all eight lanes."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return _splat(builder, builder.load(builder.gep(data, [args[1]])))

    return _lanes(array, types.intp), emit


def _prefetch(context: Any, builder: Any, signature: Any, args: Any, write: int) -> Any:
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    pointer = builder.bitcast(builder.gep(data, [args[1]]), _BYTE.as_pointer())
    # Keep in all levels of the cache; data, not instructions.
    _llvm(builder, "llvm.prefetch.p0", ir.VoidType(), (pointer, _INT(write), _INT(3), _INT(1)))
    return context.get_dummy_value()


@intrinsic
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Asks for the cache line of an element to be brought near."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _prefetch(context, builder, signature, args, 0)

    return types.void(array, types.intp), emit


@intrinsic
def prefetch_write(typing_context: Any, array: Any, index: Any) -> Any:
    """As `prefetch`, for an element that will be written."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _prefetch(context, builder, signature, args, 1)

    return types.void(array, types.intp), emit


@intrinsic
def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Writes eight numbers to a contiguous float32 vector from `index` on."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _lanes_pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes), emit


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Returns a * b + c, rounded once where the machine can."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.fmuladd.v8f32", _LANES, args)

    return _lanes(_lanes, _lanes, _lanes), emit


@intrinsic
def fnma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Returns c - a * b, rounded once where the machine can."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b, c = args
        return _llvm(builder, "llvm.fmuladd.v8f32", _LANES, (builder.fneg(a), b, c))

    return _lanes(_lanes, _lanes, _lanes), emit


@intrinsic
def square_root(typing_context: Any, a: Any) -> Any:
    """Returns the square roots."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.sqrt.v8f32", _LANES, args)

    return _lanes(_lanes), emit


@intrinsic
def round_up(typing_context: Any, a: Any) -> Any:
    """Returns the smallest whole numbers that are not smaller."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.ceil.v8f32", _LANES, args)

    return _lanes(_lanes), emit


@intrinsic
def round_down(typing_context: Any, a: Any) -> Any:
    """Returns the largest whole numbers that are not larger."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.floor.v8f32", _LANES, args)

    return _lanes(_lanes), emit


@intrinsic
def magnitude(typing_context: Any, a: Any) -> Any:
    """Returns the absolute values."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.fabs.v8f32", _LANES, args)

    return _lanes(_lanes), emit


@intrinsic
def as_negative(typing_context: Any, a: Any) -> Any:
    """Returns minus the absolute values (sets the sign bits)."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INT_LANES)
        return builder.bitcast(builder.or_(bits, _repeat(-(2**31), _INT)), _LANES)

    return _lanes(_lanes), emit


@intrinsic
def smaller(typing_context: Any, a: Any, b: Any) -> Any:
    """Returns the smaller of each two numbers; `b` where they do not compare."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return _lanes(_lanes, _lanes), emit


@intrinsic
def larger(typing_context: Any, a: Any, b: Any) -> Any:
    """Returns the larger of each two numbers; `b` where they do not compare."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return _lanes(_lanes, _lanes), emit


@intrinsic
def where(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """Returns `a` where the mask is true and `b` elsewhere."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(*args)

    return _lanes(_mask, _lanes, _lanes), emit


@intrinsic
def bits(typing_context: Any, mask: Any) -> Any:
    """Returns the mask as a number from 0 to 255, lane 0 in the lowest bit (uint64)."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _LONG)

    return types.uint64(_mask), emit


@intrinsic
def lowest_bit(typing_context: Any, number: Any) -> Any:
    """Returns the position of the lowest set bit of a uint64 (64 for zero)."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.cttz.i64", _LONG, (args[0], ir.IntType(1)(0)))

    return types.int64(types.uint64), emit


@intrinsic
def count_bits(typing_context: Any, number: Any) -> Any:
    """Returns the number of set bits of a uint64."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _llvm(builder, "llvm.ctpop.i64", _LONG, args)

    return types.int64(types.uint64), emit


@intrinsic
def scale_by_power(typing_context: Any, value: Any, shifted: Any) -> Any:
    """Returns value * 2**n where `shifted` is n + 1.5 * 2**23, so that its lowest bits hold n."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, shifted = (builder.bitcast(arg, _INT_LANES) for arg in args)
        exponent = builder.shl(shifted, _repeat(23, _INT))
        return builder.bitcast(builder.add(value, exponent), _LANES)

    return _lanes(_lanes, _lanes), emit


@intrinsic
def sums(
    typing_context: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any
) -> Any:
    """Returns the eight vectors' sums over their lanes, in the order of the arguments."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def add_pairs(x: Any, y: Any, width: int) -> Any:
            """Folds lane groups of `width` onto each other: x's into low, y's into high groups."""
            blocks = range(0, LANES, 2 * width)
            low = [s + i for start in blocks for s in (start, start + LANES) for i in range(width)]
            return builder.fadd(
                _shuffle(builder, x, y, low),
                _shuffle(builder, x, y, [lane + width for lane in low]),
            )

        rows = list(args)
        for width in (1, 2, 4):
            rows = [add_pairs(rows[i], rows[i + 1], width) for i in range(0, len(rows), 2)]
        return rows[0]

    return _lanes(*([_lanes] * LANES)), emit


@intrinsic
def total(typing_context: Any, a: Any) -> Any:
    """Returns the sum of the lanes (float32), added in pairs."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (row,) = args
        for width in (1, 2, 4):
            order = [lane ^ width for lane in range(LANES)]
            row = builder.fadd(row, _shuffle(builder, row, row, order))
        return builder.extract_element(row, _INT(0))

    return types.float32(_lanes), emit
