"""SIMD vectors of eight or sixteen float32 lanes for compiled kernels.

Numba relies on LLVM's loop vectoriser. The vectoriser fails for compositing loops, because each
iteration depends on the previous iteration. The module therefore defines vector types: `Lanes` for
float32 numbers, and `Mask` for truth values. A kernel that uses these types always compiles to SIMD
instructions. A vector of eight lanes uses one AVX register. On machines with narrower registers,
LLVM splits the vector. Functions whose names end in `_wide` create vectors of sixteen lanes. With
AVX-512, sixteen lanes need half as many instructions. Other machines need two instructions for each
operation. All other functions accept vectors of eight and of sixteen lanes. Operations are never
reordered, and `fma` is always fused on machines that support fused operations. Equal expressions in
two kernels therefore give equal bits.

The functions work only inside compiled kernels. `Lanes` and `Mask` serve as type annotations. A
kernel that needs further lane operations can define its own operations with `emitted` and the
helper functions of this module.
"""
# ruff: noqa: ANN401, ARG005 - Numba's objects have no types, and Numba defines the arguments.

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_device

LANES = 8
WIDE = 2 * LANES

_FLOAT, _BYTE, _INT, _LONG = ir.FloatType(), ir.IntType(8), ir.IntType(32), ir.IntType(64)
_ALIGNMENT = 4  # In bytes. Float32 arrays guarantee no larger alignment.
_SIGN_BIT, _MANTISSA_BITS = -(2**31), 23


class Mask(Protocol):
    """Eight or sixteen truth values."""

    def __and__(self, other: "Mask") -> "Mask": ...


class Lanes(Protocol):
    """Eight or sixteen float32 numbers."""

    def __add__(self, other: "Lanes") -> "Lanes": ...
    def __sub__(self, other: "Lanes") -> "Lanes": ...
    def __mul__(self, other: "Lanes") -> "Lanes": ...
    def __truediv__(self, other: "Lanes") -> "Lanes": ...
    def __ge__(self, other: "Lanes") -> Mask: ...
    def __le__(self, other: "Lanes") -> Mask: ...
    def __lt__(self, other: "Lanes") -> Mask: ...


class _LanesType(types.Type):
    def __init__(self, width: int) -> None:
        self.width = width
        cast("Any", super()).__init__(name=f"Lanes{width}")


class _MaskType(types.Type):
    def __init__(self, width: int) -> None:
        self.width = width
        cast("Any", super()).__init__(name=f"Mask{width}")


#: Types of vectors, not yet with a number of lanes. Call `_lanes` or `_mask` with a number of lanes
#: to get a type.
_lanes, _mask = _LanesType, _MaskType


def _floats(width: int) -> ir.Type:
    return ir.VectorType(_FLOAT, width)


def whole_type(a: Any) -> ir.Type:
    """Return the int32 vector type with as many elements as the LLVM vector `a`."""
    return ir.VectorType(_INT, a.type.count)


#: Numba type of a vector of sixteen float32 numbers.
SIXTEEN = _lanes(WIDE)
_eight = _lanes(LANES)
_triple, _four = (cast("Any", types).UniTuple(_eight, count) for count in (3, 4))


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        cast("Any", super()).__init__(manager, numba_type, _floats(numba_type.width))


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        cast("Any", super()).__init__(
            manager, numba_type, ir.VectorType(ir.IntType(1), numba_type.width)
        )


class Site(NamedTuple):
    """The place where a function is called.

    A `Site` contains Numba's context, LLVM's builder, and the Numba types of the operands.
    """

    context: Any
    builder: Any
    operands: tuple[Any, ...]


def emitted(emit: Callable[..., Any], result: Any, *operands: Any) -> Any:
    """Create a function that kernels can call.

    Args:
        emit: Function that emits the instructions. The function receives the `Site` and the
            operands' LLVM values.
        result: Numba type of the result, such as `SIXTEEN`. `_lanes` and `_mask` mean a vector with
            as many lanes as the operands' vectors.
        operands: Numba types of the operands, also with `_lanes` and `_mask`. An operand type of
            None means any array.
    """

    def define(*given: Any) -> Any:
        widths = (kind.width for kind in given if isinstance(kind, _LanesType | _MaskType))
        width = next(widths, LANES)

        def typed(kind: Any, other: Any) -> Any:
            if kind is None:
                return other
            return kind(width) if kind in (_lanes, _mask) else kind

        kinds = [typed(kind, other) for kind, other in zip(operands, given, strict=True)]

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(Site(context, builder, signature.args), *args)

        return typed(result, None)(*kinds), generate

    # Numba reads the number of operands from the Python signature, so each number needs its own
    # function.
    by_count: dict[int, Callable[..., Any]] = {
        0: lambda typing: define(),
        1: lambda typing, a: define(a),
        2: lambda typing, a, b: define(a, b),
        3: lambda typing, a, b, c: define(a, b, c),
        5: lambda typing, a, b, c, d, e: define(a, b, c, d, e),
        8: lambda typing, a, b, c, d, e, f, g, h: define(a, b, c, d, e, f, g, h),
    }
    return intrinsic(by_count[len(operands)])


def _define(sign: Callable[[Any, Any], Any], emit: Callable[..., Any], kind: Any, to: Any) -> None:
    """Define a Python operator for two vectors of the type `kind`."""
    implementation = emitted(emit, to, kind, kind)

    # Without `strict=False`, Numba would compare the annotations with the signature.
    @overload(sign, strict=False)
    def _overloaded(a: Any, b: Any) -> Any:
        if isinstance(a, kind) and a == b:
            return lambda a, b: implementation(a, b)  # noqa: PLW0108 - Numba compiles the lambda
        return None


_define(operator.add, lambda at, a, b: at.builder.fadd(a, b), _lanes, _lanes)
_define(operator.sub, lambda at, a, b: at.builder.fsub(a, b), _lanes, _lanes)
_define(operator.mul, lambda at, a, b: at.builder.fmul(a, b), _lanes, _lanes)
_define(operator.truediv, lambda at, a, b: at.builder.fdiv(a, b), _lanes, _lanes)
_define(operator.ge, lambda at, a, b: at.builder.fcmp_ordered(">=", a, b), _lanes, _mask)
_define(operator.le, lambda at, a, b: at.builder.fcmp_ordered("<=", a, b), _lanes, _mask)
_define(operator.lt, lambda at, a, b: at.builder.fcmp_ordered("<", a, b), _lanes, _mask)
_define(operator.and_, lambda at, a, b: at.builder.and_(a, b), _mask, _mask)


def _llvm(name: str, result: ir.Type | None = None) -> Callable[..., Any]:
    """Return a function that emits a call of an LLVM intrinsic.

    If `result` is None, the intrinsic works on float32 vectors.
    """

    def emit(at: Site, *args: Any) -> Any:
        full = name if result else f"{name}.v{args[0].type.count}f32"
        function = at.builder.module.globals.get(full)
        if function is None:
            signature = ir.FunctionType(result or args[0].type, [arg.type for arg in args])
            function = ir.Function(at.builder.module, signature, full)
        return at.builder.call(function, args)

    return emit


def _element(at: Site, array: Any, index: Any, kind: ir.Type) -> Any:
    """Return the address of an array element. The index is not checked and must not be negative."""
    data = at.context.make_array(at.operands[0])(at.context, at.builder, array).data
    return at.builder.bitcast(at.builder.gep(data, [index]), kind.as_pointer())


def shuffled(at: Site, a: Any, b: Any, order: Sequence[int]) -> Any:
    """Return the lanes of `a` and `b` in the order `order`.

    Lanes of `b` are numbered after the lanes of `a`.
    """
    places = ir.Constant(ir.VectorType(_INT, len(order)), list(order))
    return at.builder.shuffle_vector(a, b, places)


def _splat(width: int) -> Callable[..., Any]:
    def emit(at: Site, value: Any) -> Any:
        empty = ir.Constant(_floats(width), ir.Undefined)
        single = at.builder.insert_element(empty, value, _INT(0))
        return shuffled(at, single, single, [0] * width)

    return emit


def _load(width: int) -> Callable[..., Any]:
    def emit(at: Site, array: Any, index: Any) -> Any:
        return at.builder.load(_element(at, array, index, _floats(width)), align=_ALIGNMENT)

    return emit


def _broadcast(width: int) -> Callable[..., Any]:
    def emit(at: Site, array: Any, index: Any) -> Any:
        return _splat(width)(at, at.builder.load(_element(at, array, index, _FLOAT)))

    return emit


def _broadcast_four(width: int) -> Callable[..., Any]:
    def emit(at: Site, array: Any, index: Any) -> Any:
        four = at.builder.load(_element(at, array, index, _floats(4)), align=_ALIGNMENT)
        return shuffled(at, four, four, [0, 1, 2, 3] * (width // 4))

    return emit


def picking(order: Sequence[int]) -> Callable[[Lanes, Lanes], Lanes]:
    """Create a function that selects lanes from two vectors of sixteen lanes in a fixed order.

    Args:
        order: Sixteen lane numbers; numbers from 16 on select lanes of the second vector.
    """
    pick = emitted(lambda at, a, b: shuffled(at, a, b, order), SIXTEEN, SIXTEEN, SIXTEEN)
    return cast("Callable[[Lanes, Lanes], Lanes]", pick)


def _halves_added(at: Site, a: Any) -> Any:
    low, high = (shuffled(at, a, a, range(start, start + LANES)) for start in (0, LANES))
    return at.builder.fadd(low, high)


def _store(at: Site, array: Any, index: Any, value: Any) -> Any:
    at.builder.store(value, _element(at, array, index, value.type), align=_ALIGNMENT)
    return at.context.get_dummy_value()


def _load_triples(at: Site, array: Any, index: Any) -> Any:
    a, b, c = _parts(at, array, index)
    first, last = at.builder.load(a, align=_ALIGNMENT), at.builder.load(c, align=_ALIGNMENT)
    two = shuffled(at, first, at.builder.load(b, align=_ALIGNMENT), range(WIDE))
    three = shuffled(at, two, shuffled(at, last, last, range(WIDE)), range(3 * LANES))
    picked = [shuffled(at, three, three, range(i, 3 * LANES, 3)) for i in range(3)]
    return at.context.make_tuple(at.builder, _triple, picked)


def _load_fours(at: Site, array: Any, index: Any) -> Any:
    a, b, c, d = (at.builder.load(p, align=_ALIGNMENT) for p in _parts(at, array, index, 4))
    low, high = shuffled(at, a, b, range(WIDE)), shuffled(at, c, d, range(WIDE))
    picked = [shuffled(at, low, high, range(i, 2 * WIDE, 4)) for i in range(4)]
    return at.context.make_tuple(at.builder, _four, picked)


def _store_triples(at: Site, array: Any, index: Any, x: Any, y: Any, z: Any) -> Any:
    two, third = shuffled(at, x, y, range(WIDE)), shuffled(at, z, z, range(WIDE))
    mixed = [i + LANES * channel for i in range(LANES) for channel in range(3)]
    for part, address in enumerate(_parts(at, array, index)):
        here = shuffled(at, two, third, mixed[part * LANES : (part + 1) * LANES])
        at.builder.store(here, address, align=_ALIGNMENT)
    return at.context.get_dummy_value()


def _parts(at: Site, array: Any, index: Any, count: int = 3) -> list[Any]:
    """Return the addresses of `count` consecutive vectors of eight lanes."""
    places = [at.builder.add(index, ir.Constant(index.type, i * LANES)) for i in range(count)]
    return [_element(at, array, start, _floats(LANES)) for start in places]


def _prefetch(at: Site, array: Any, index: Any, *, write: int) -> Any:
    address = _element(at, array, index, _BYTE)
    # Argument 3: keep the cache line in all cache levels. Argument 1: the cache line contains data,
    # not instructions.
    _llvm("llvm.prefetch.p0", ir.VoidType())(at, address, _INT(write), _INT(3), _INT(1))
    return at.context.get_dummy_value()


def _negated_fma(at: Site, a: Any, b: Any, c: Any) -> Any:
    return _llvm("llvm.fmuladd")(at, at.builder.fneg(a), b, c)


def _as_negative(at: Site, a: Any) -> Any:
    sign = ir.Constant(whole_type(a), [_SIGN_BIT] * a.type.count)
    return at.builder.bitcast(at.builder.or_(at.builder.bitcast(a, whole_type(a)), sign), a.type)


def _pick(sign: str) -> Callable[..., Any]:
    def emit(at: Site, a: Any, b: Any) -> Any:
        return at.builder.select(at.builder.fcmp_ordered(sign, a, b), a, b)

    return emit


def _bits(at: Site, mask: Any) -> Any:
    return at.builder.zext(at.builder.bitcast(mask, ir.IntType(mask.type.count)), _LONG)


def _scale_by_power(at: Site, value: Any, shifted: Any) -> Any:
    whole = whole_type(value)
    places = ir.Constant(whole, [_MANTISSA_BITS] * value.type.count)
    exponent = at.builder.shl(at.builder.bitcast(shifted, whole), places)
    scaled = at.builder.add(at.builder.bitcast(value, whole), exponent)
    return at.builder.bitcast(scaled, value.type)


def _sums(at: Site, *args: Any) -> Any:
    rows = list(args)
    for width in (1, 2, 4):
        # Add each group of `width` lanes to its neighbouring group. Each pair of vectors becomes
        # one vector.
        starts = [s + o for s in range(0, LANES, 2 * width) for o in (0, LANES)]
        low = [start + lane for start in starts for lane in range(width)]
        high = [lane + width for lane in low]
        pairs = zip(rows[::2], rows[1::2], strict=True)
        rows = [
            at.builder.fadd(shuffled(at, a, b, low), shuffled(at, a, b, high)) for a, b in pairs
        ]
    return rows[0]


def _total(at: Site, a: Any) -> Any:
    for width in (1, 2, 4):
        a = at.builder.fadd(a, shuffled(at, a, a, [lane ^ width for lane in range(LANES)]))
    return at.builder.extract_element(a, _INT(0))


def _ramp(width: int) -> Callable[..., Any]:
    return lambda at: ir.Constant(_floats(width), [float(lane) for lane in range(width)])


_Array = NDArray[Any]
_Three = tuple[Lanes, Lanes, Lanes]
_Four = tuple[Lanes, Lanes, Lanes, Lanes]

#: Return a vector with the float32 number in all eight lanes.
splat: Callable[[np.float32], Lanes] = emitted(_splat(LANES), _eight, types.float32)
#: Return the vector (0, 1, ..., 7).
ramp: Callable[[], Lanes] = emitted(_ramp(LANES), _eight)
#: Return eight consecutive numbers of a one-dimensional float32 array, starting at an index.
load: Callable[[_Array, int], Lanes] = emitted(_load(LANES), _eight, None, types.intp)
#: Return one number of a one-dimensional float32 array in all eight lanes.
broadcast: Callable[[_Array, int], Lanes] = emitted(_broadcast(LANES), _eight, None, types.intp)
#: Return four consecutive numbers of a one-dimensional float32 array in lanes 0 to 3, and again in
#: lanes 4 to 7.
broadcast_four: Callable[[_Array, int], Lanes] = emitted(
    _broadcast_four(LANES), _eight, None, types.intp
)
#: Return a vector with the float32 number in all sixteen lanes.
splat_wide: Callable[[np.float32], Lanes] = emitted(_splat(WIDE), SIXTEEN, types.float32)
#: Return the vector (0, 1, ..., 15).
ramp_wide: Callable[[], Lanes] = emitted(_ramp(WIDE), SIXTEEN)
#: Return sixteen consecutive numbers of a one-dimensional float32 array, starting at an index.
load_wide: Callable[[_Array, int], Lanes] = emitted(_load(WIDE), SIXTEEN, None, types.intp)
#: Return one number of a one-dimensional float32 array in all sixteen lanes.
broadcast_wide: Callable[[_Array, int], Lanes] = emitted(
    _broadcast(WIDE), SIXTEEN, None, types.intp
)
#: Return four consecutive numbers of a one-dimensional float32 array in each group of four lanes.
broadcast_four_wide: Callable[[_Array, int], Lanes] = emitted(
    _broadcast_four(WIDE), SIXTEEN, None, types.intp
)
#: Join two vectors of eight lanes to one vector of sixteen lanes.
joined: Callable[[Lanes, Lanes], Lanes] = emitted(
    lambda at, a, b: shuffled(at, a, b, range(WIDE)), SIXTEEN, _eight, _eight
)
#: Return the first eight of sixteen lanes.
first_half: Callable[[Lanes], Lanes] = emitted(
    lambda at, a: shuffled(at, a, a, range(LANES)), _eight, SIXTEEN
)
#: Return the last eight of sixteen lanes.
last_half: Callable[[Lanes], Lanes] = emitted(
    lambda at, a: shuffled(at, a, a, range(LANES, WIDE)), _eight, SIXTEEN
)
#: Add the first eight lanes to the last eight of sixteen lanes; the result has eight lanes.
halves_added: Callable[[Lanes], Lanes] = emitted(_halves_added, _eight, SIXTEEN)
#: Load eight consecutive triples, such as RGB pixels, from a contiguous float32 array. Return one
#: vector for each of the three components.
load_triples: Callable[[_Array, int], _Three] = emitted(_load_triples, _triple, None, types.intp)
#: Load eight consecutive groups of four numbers, such as quaternions. Return one vector for each of
#: the four components.
load_fours: Callable[[_Array, int], _Four] = emitted(_load_fours, _four, None, types.intp)
#: Store three vectors as eight consecutive triples; the index counts single numbers.
store_triples: Callable[[_Array, int, Lanes, Lanes, Lanes], None] = emitted(
    _store_triples, types.void, None, types.intp, _eight, _eight, _eight
)
#: Store a vector in a one-dimensional float32 array, starting at an index.
store: Callable[[_Array, int, Lanes], None] = emitted(_store, types.void, None, types.intp, _lanes)
#: Prefetch the cache line of an element of a contiguous array; the index counts single numbers.
prefetch: Callable[[_Array, int], None] = emitted(
    lambda at, array, index: _prefetch(at, array, index, write=0), types.void, None, types.intp
)
#: Like `prefetch`, but for an element that will be written.
prefetch_write: Callable[[_Array, int], None] = emitted(
    lambda at, array, index: _prefetch(at, array, index, write=1), types.void, None, types.intp
)
#: Return a b + c. The result is rounded only once if the machine has a fused multiply-add
#: instruction.
fma: Callable[[Lanes, Lanes, Lanes], Lanes] = emitted(
    _llvm("llvm.fmuladd"), _lanes, _lanes, _lanes, _lanes
)
#: Return c - a b. The result is rounded only once if the machine has a fused multiply-add
#: instruction.
fnma: Callable[[Lanes, Lanes, Lanes], Lanes] = emitted(_negated_fma, _lanes, _lanes, _lanes, _lanes)
#: Return the square root of each lane.
square_root: Callable[[Lanes], Lanes] = emitted(_llvm("llvm.sqrt"), _lanes, _lanes)
#: Round each lane up to a whole number.
round_up: Callable[[Lanes], Lanes] = emitted(_llvm("llvm.ceil"), _lanes, _lanes)
#: Round each lane down to a whole number.
round_down: Callable[[Lanes], Lanes] = emitted(_llvm("llvm.floor"), _lanes, _lanes)
#: Return the absolute value of each lane.
magnitude: Callable[[Lanes], Lanes] = emitted(_llvm("llvm.fabs"), _lanes, _lanes)
#: Return the negative absolute value of each lane.
as_negative: Callable[[Lanes], Lanes] = emitted(_as_negative, _lanes, _lanes)
#: Return the smaller number in each lane. If a number is NaN, return the second number.
smaller: Callable[[Lanes, Lanes], Lanes] = emitted(_pick("<"), _lanes, _lanes, _lanes)
#: Return the larger number in each lane. If a number is NaN, return the second number.
larger: Callable[[Lanes, Lanes], Lanes] = emitted(_pick(">"), _lanes, _lanes, _lanes)
#: In each lane, return the first number if the mask is True, else the second number.
where: Callable[[Mask, Lanes, Lanes], Lanes] = emitted(
    lambda at, mask, a, b: at.builder.select(mask, a, b), _lanes, _mask, _lanes, _lanes
)
#: Return the mask as an integer; the lowest bit belongs to lane 0.
bits: Callable[[Mask], np.uint64] = emitted(_bits, types.uint64, _mask)
#: Return the position of the lowest set bit, or 64 for zero.
lowest_bit: Callable[[np.uint64], int] = emitted(
    lambda at, number: _llvm("llvm.cttz.i64", _LONG)(at, number, ir.IntType(1)(0)),
    *(types.int64, types.uint64),
)
#: Return the number of set bits.
count_bits: Callable[[np.uint64], int] = emitted(
    _llvm("llvm.ctpop.i64", _LONG), types.int64, types.uint64
)
#: Return value * 2^n. The second vector must contain n + 1.5 * 2^23, because the lowest bits of
#: this float32 number are n.
scale_by_power: Callable[[Lanes, Lanes], Lanes] = emitted(_scale_by_power, _lanes, _lanes, _lanes)
#: Return a vector of eight sums: lane i contains the sum over all lanes of vector i. Lanes are
#: added in pairs.
sums: Callable[[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes], Lanes] = emitted(
    _sums, _eight, *([_eight] * LANES)
)
#: Return the sum over all eight lanes. Lanes are added in pairs.
total: Callable[[Lanes], np.float32] = emitted(_total, types.float32, _eight)


@strict_device
def aligned(count: int) -> NDArray[np.float32]:
    """Return an array of `count` numbers that is aligned to cache lines.

    No vector in the array spans two cache lines.
    """
    room = np.empty(count + WIDE, np.float32)
    shift = (-(room.ctypes.data // room.itemsize)) % WIDE
    return room[shift : shift + count]
