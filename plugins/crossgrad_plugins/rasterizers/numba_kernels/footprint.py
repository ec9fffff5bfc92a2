"""Which patches of a tile a Gaussian reaches, and its 1-D Gaussian in each row."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    broadcast_wide,
    fma,
    fnma,
    ramp_wide,
    round_down,
    round_up,
    splat_wide,
    square_root,
    store,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    LOG_OPACITY,
    MIDDLE,
    ROW_DECAY,
    SLOPE,
    SPARE,
    TILE_HEIGHT,
    TOUCH,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    WIDTH,
)
from crossgrad_plugins.rasterizers.numba_kernels.reach import reached_patches

#: Row buffer of one Gaussian: centre of each row, its largest exponent, its dy.
ROW_CENTRE = 0
ROW_EXPONENT = TILE_HEIGHT
ROW_DY = 2 * TILE_HEIGHT
ROWS = 3 * TILE_HEIGHT


@device
def fill_rows(
    records: NDArray[np.float32],
    record: int,
    left: np.float32,
    top: np.float32,
    rows: NDArray[np.float32],
    base: int,
) -> np.uint64:
    """Writes the row buffer at `base` and returns the reached patches as bits.

    `left`, `top` are the tile's corner in pixels; row centres are relative to the middle of a pixel
    of the middle column.
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
    # One lane for each row of the tile.
    dy = ramp_wide() - v
    exponent = fnma(row_decay * dy, dy, broadcast_wide(records, record + LOG_OPACITY))
    centre = fma(broadcast_wide(records, record + SLOPE), dy, u)
    store(rows, base + ROW_CENTRE, centre)
    store(rows, base + ROW_EXPONENT, exponent)
    store(rows, base + ROW_DY, dy)
    # NaN in rows that the Gaussian does not reach; NaN passes no comparison.
    budget = (exponent + splat_wide(np.float32(SPARE - TOUCH))) * broadcast_wide(
        records, record + WIDTH
    )
    extent = square_root(budget)
    first = round_up(centre - extent)
    last = round_down(centre + extent)
    return reached_patches(first + middle, last + middle)
