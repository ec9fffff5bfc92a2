"""Eight float32 numbers as one value inside kernels.

LLVM's own vectoriser gives up on loops that read a dozen rows and write several, because it cannot
prove that the rows do not overlap. These functions, which exist inside kernels only, say what is
meant: one vector per operation. Where registers are narrower or wider LLVM splits or joins vectors.

Numba's cache on disk does not notice changes of this file: delete `__pycache__` after an edit.
"""
# ruff: noqa: ANN401, ARG001 - Numba's extension points are untyped and fix the arguments.

import operator
from collections.abc import Callable, Sequence
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

LANES = 8
_ALIGNMENT = 4  # bytes: arrays are aligned for float32 only
_FLAGS = ("contract", "nsz")

_FLOAT = ir.FloatType()
_INDEX = ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_TYPES = cast("Any", types)


class _F32x8(types.Type):
    """Numba's name for the type."""

    def __init__(self) -> None:
        cast("Any", super()).__init__(name="F32x8")


f32x8 = cast("Any", _F32x8())


@register_model(_F32x8)
class _F32x8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        cast("Any", super()).__init__(manager, numba_type, _VECTOR)


def emitted(function: Callable[..., Any]) -> Any:
    """`numba.extending.intrinsic`, typed so that kernels may call the result."""
    return cast("Any", intrinsic(function))


def vector_at(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Loads the vector that starts at element `index` of a 1-D contiguous float32 array."""
    vector = builder.load(_pointer(context, builder, array_type, array, index))
    vector.align = _ALIGNMENT
    return vector


def product(builder: Any, left: Any, right: Any) -> Any:
    """The product of two vectors."""
    return builder.fmul(left, right, flags=_FLAGS)


def symmetric_sum(builder: Any, taps: Sequence[Any], weights: Sequence[float]) -> Any:
    """Weighted sum of an odd number of vectors; weights run from the outer pair to the centre."""
    middle = len(taps) // 2
    total = product(builder, taps[middle], _constant(weights[middle]))
    for k in range(middle - 1, -1, -1):
        pair = builder.fadd(taps[k], taps[-1 - k], flags=_FLAGS)
        scaled = product(builder, pair, _constant(weights[k]))
        total = builder.fadd(total, scaled, flags=_FLAGS)
    return total


@emitted
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """Elements index .. index + 7 of a 1-D contiguous float32 array."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return vector_at(context, builder, signature.args[0], *args)

    return f32x8(array, _TYPES.intp), generate


@emitted
def store(typing_context: Any, array: Any, index: Any, vector: Any) -> Any:
    """Writes `vector` to elements index .. index + 7 of a 1-D contiguous float32 array."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], pointer).align = _ALIGNMENT
        return context.get_dummy_value()

    return _TYPES.void(array, _TYPES.intp, f32x8), generate


@emitted
def splat(typing_context: Any, value: Any) -> Any:
    """A float32 number in all eight lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, args[0], ir.Constant(_INDEX, 0))
        lanes = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
        return builder.shuffle_vector(first, undefined, lanes)

    return f32x8(_TYPES.float32), generate


@emitted
def where_positive(typing_context: Any, condition: Any, yes: Any, no: Any) -> Any:
    """Lane by lane: `yes` where condition > 0, else `no` (also where the condition is NaN)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        positive = builder.fcmp_ordered(">", args[0], _constant(0.0))
        return builder.select(positive, args[1], args[2])

    return f32x8(f32x8, f32x8, f32x8), generate


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _constant(value: float) -> Any:
    return ir.Constant(_VECTOR, [value] * LANES)


def _define(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    """Gives a Python operator its meaning between two vectors."""

    @emitted
    def operation(typing_context: Any, left: Any, right: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*args, flags=_FLAGS)

        return f32x8(f32x8, f32x8), generate

    @overload(symbol, strict=False)  # the annotations above are no part of the signature
    def implementation(left: Any, right: Any) -> Any:
        if isinstance(left, _F32x8) and isinstance(right, _F32x8):
            return lambda left, right: operation(left, right)  # noqa: PLW0108 - Numba reads it
        return None


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")
