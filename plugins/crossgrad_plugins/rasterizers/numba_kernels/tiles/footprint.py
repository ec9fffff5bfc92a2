"""The patches of a tile that a Gaussian reaches, and its 1-D Gaussian in each pixel row."""
# ruff: noqa: ANN401 - Numba's and LLVM's objects have no types.

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    SIXTEEN,
    WIDE,
    Lanes,
    Site,
    broadcast_wide,
    emitted,
    fma,
    fnma,
    ramp_wide,
    round_down,
    round_up,
    shuffled,
    splat_wide,
    square_root,
    store,
    whole_type,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COLUMNS,
    LOG_OPACITY,
    MIDDLE,
    ROW_DECAY,
    SIDE,
    SLOPE,
    SPARE,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCH,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    WIDTH,
)

#: Row buffer of a Gaussian: for each pixel row, the centre, the largest exponent and dy.
ROW_CENTRE = 0
ROW_EXPONENT = TILE_HEIGHT
ROW_DY = 2 * TILE_HEIGHT
ROWS = 3 * TILE_HEIGHT
# The bit shifts below require patches of 4 x 4 pixels and sixteen columns of patches.
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
    # Set edges outside the tile to 0, because an edge may be NaN, which cannot be converted to an
    # integer.
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


#: Return the reached patches of the sixteen pixel rows of a tile, from the first and last pixel of
#: each row. A row has no pixel if first <= last is false. Bit 16 r + c is the patch of columns 4 c
#: to 4 c + 3 and rows 4 r to 4 r + 3. Only pixels 0 to 63 of a row count.
reached_patches: Callable[[Lanes, Lanes], np.uint64] = emitted(
    _reached_patches, types.uint64, SIXTEEN, SIXTEEN
)


@device
def fill_rows(
    records: NDArray[np.float32],
    record: int,
    left: np.float32,
    top: np.float32,
    rows: NDArray[np.float32],
    base: int,
) -> np.uint64:
    """Write the row buffer at `base`, and return the reached patches as bits.

    `left` and `top` are the pixel coordinates of the tile's corner. Centres of rows are relative to
    the centre of a pixel in the middle column.
    """
    half = splat_wide(np.float32(0.5))
    middle = splat_wide(np.float32(MIDDLE))
    u = (broadcast_wide(records, record + U_WHOLE) - (splat_wide(left) + middle)) + (
        broadcast_wide(records, record + U_PART) - half
    )
    v = (broadcast_wide(records, record + V_WHOLE) - splat_wide(top)) + (
        broadcast_wide(records, record + V_PART) - half
    )
    row_decay = broadcast_wide(records, record + ROW_DECAY)
    # Each lane belongs to a pixel row of the tile.
    dy = ramp_wide() - v
    exponent = fnma(row_decay * dy, dy, broadcast_wide(records, record + LOG_OPACITY))
    centre = fma(broadcast_wide(records, record + SLOPE), dy, u)
    store(rows, base + ROW_CENTRE, centre)
    store(rows, base + ROW_EXPONENT, exponent)
    store(rows, base + ROW_DY, dy)
    # Values of rows that the Gaussian does not reach are NaN, for which every comparison is false.
    budget = (exponent + splat_wide(np.float32(SPARE - TOUCH))) * broadcast_wide(
        records, record + WIDTH
    )
    extent = square_root(budget)
    first = round_up(centre - extent)
    last = round_down(centre + extent)
    return reached_patches(first + middle, last + middle)
