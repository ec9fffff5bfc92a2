"""Which patches of a tile a Gaussian reaches, from the first and the last pixel of each row."""
# ruff: noqa: ANN401 - Numba's and LLVM's objects have no types.

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types

from crossgrad_core.numerics.simd import (
    SIXTEEN,
    WIDE,
    Lanes,
    Site,
    emitted,
    shuffled,
    whole_type,
)
from crossgrad_plugins.rasterizers.numba_kernels.layout import COLUMNS, SIDE, TILE_WIDTH

# How bits are shifted and joined below is for patches of 4 x 4 pixels and sixteen columns of them.
_LAST = float(TILE_WIDTH - 1)


def _reached_patches(at: Site, first: Any, last: Any) -> Any:
    build, whole = at.builder, whole_type(first)

    def number(kind: ir.Type, value: float) -> Any:
        return ir.Constant(kind, [value] * WIDE)

    zero, end = number(first.type, 0.0), number(first.type, _LAST)
    inside = build.and_(
        build.fcmp_ordered("<=", first, last),
        build.and_(build.fcmp_ordered("<=", first, end), build.fcmp_ordered(">=", last, zero)),
    )
    low = build.select(build.fcmp_ordered(">", first, zero), first, zero)
    high = build.select(build.fcmp_ordered("<", last, end), last, end)
    # Where nothing is inside there may be NaN, of which no whole number can be made.
    columns = [
        build.lshr(build.fptosi(build.select(inside, edge, zero), whole), number(whole, 2))
        for edge in (low, high)
    ]
    run = build.sub(
        build.shl(number(whole, 2), columns[1]), build.shl(number(whole, 1), columns[0])
    )
    run = build.select(inside, run, number(whole, 0))
    for distance in (1, 2):
        run = build.or_(run, shuffled(at, run, run, [lane ^ distance for lane in range(WIDE)]))
    sides = shuffled(at, run, run, range(0, WIDE, SIDE))
    four = build.trunc(sides, ir.VectorType(ir.IntType(COLUMNS), WIDE // SIDE))
    return build.bitcast(four, ir.IntType(64))


#: Returns the patches reached in the sixteen rows of a tile, given the first and the last pixel of
#: each (none where these do not compare): in bit 16 r + c the patch of columns 4 c to 4 c + 3 of
#: rows 4 r to 4 r + 3. Pixels are counted from 0 to 63; others are left out.
reached_patches: Callable[[Lanes, Lanes], np.uint64] = emitted(
    _reached_patches, types.uint64, SIXTEEN, SIXTEEN
)
