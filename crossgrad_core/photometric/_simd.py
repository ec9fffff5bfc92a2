"""Eight float32 numbers as one value inside Numba code.

LLVM's own vectoriser gives up on loops that read a dozen rows and write several, because it cannot
prove that the rows do not overlap. These intrinsics say what is meant: one vector per operation. On
machines with narrower or wider registers LLVM splits or joins them; the results are the same.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

LANES = 8
# Fused multiply-add may be formed, the sign of zero is free; NaN and infinity stay as IEEE wants them.
FLAGS = ("contract", "nsz")

_FLOAT = ir.FloatType()
_INDEX = ir.IntType(32)
VECTOR = ir.VectorType(_FLOAT, LANES)


class F32x8(types.Type):  # type: ignore[misc]
    """Numba type of a vector of eight float32."""

    def __init__(self) -> None:
        super().__init__(name="F32x8")


f32x8 = F32x8()


@register_model(F32x8)
class _F32x8Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, numba_type: F32x8) -> None:
        super().__init__(manager, numba_type, VECTOR)


def constant(value: float) -> ir.Constant:
    """`value` in all eight lanes, for use inside an intrinsic."""
    return ir.Constant(VECTOR, [value] * LANES)


def element_pointer(
    context: Any, builder: Any, array_type: Any, array: Any, index: Any
) -> ir.Value:
    """Address of the float32 vector that starts at element `index` of a 1-D float32 array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), VECTOR.as_pointer())


def emit_load(builder: Any, pointer: ir.Value) -> ir.Value:
    """Loads a vector from an address that is aligned for float32 only."""
    vector = builder.load(pointer)
    vector.align = 4
    return vector


@intrinsic
def load(typing_context, array, index):
    """Elements index .. index + 7 of a 1-D contiguous float32 array."""

    def generate(context, builder, signature, args):
        pointer = element_pointer(context, builder, signature.args[0], *args)
        return emit_load(builder, pointer)

    return f32x8(array, types.intp), generate


@intrinsic
def store(typing_context, array, index, vector):
    """Writes `vector` to elements index .. index + 7 of a 1-D contiguous float32 array."""

    def generate(context, builder, signature, args):
        pointer = element_pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], pointer).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x8), generate


@intrinsic
def splat(typing_context, value):
    """A float32 number in all eight lanes."""

    def generate(context, builder, signature, args):
        undefined = ir.Constant(VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, args[0], ir.Constant(_INDEX, 0))
        lanes = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
        return builder.shuffle_vector(first, undefined, lanes)

    return f32x8(types.float32), generate


@intrinsic
def where_positive(typing_context, condition, yes, no):
    """Lane by lane: `yes` where condition > 0, else `no` (also where the condition is NaN)."""

    def generate(context, builder, signature, args):
        positive = builder.fcmp_ordered(">", args[0], constant(0.0))
        return builder.select(positive, args[1], args[2])

    return f32x8(f32x8, f32x8, f32x8), generate


def symmetric_sum(builder: Any, taps: Sequence[ir.Value], weights: Sequence[float]) -> ir.Value:
    """Weighted sum of an odd number of taps; `weights` runs from the outermost pair to the centre."""
    middle = len(taps) // 2
    total = builder.fmul(taps[middle], constant(weights[middle]), flags=FLAGS)
    for k in range(middle - 1, -1, -1):
        pair = builder.fadd(taps[k], taps[-1 - k], flags=FLAGS)
        scaled = builder.fmul(pair, constant(weights[k]), flags=FLAGS)
        total = builder.fadd(total, scaled, flags=FLAGS)
    return total


def _arithmetic(instruction: str) -> Callable[[Any, Any], Any]:
    @intrinsic
    def operation(typing_context, left, right):
        def generate(context, builder, signature, args):
            return getattr(builder, instruction)(*args, flags=FLAGS)

        return f32x8(f32x8, f32x8), generate

    return operation  # type: ignore[no-any-return]


def _define(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    operation = _arithmetic(instruction)

    @overload(symbol)
    def implementation(left, right):
        if isinstance(left, F32x8) and isinstance(right, F32x8):
            return lambda left, right: operation(left, right)
        return None


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")
