"""Which segments of a tile a Gaussian reaches, and its 1-D Gaussian in each row."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    LANES,
    bits,
    broadcast,
    fma,
    fnma,
    ramp,
    round_down,
    round_up,
    splat,
    square_root,
    store,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COLUMNS,
    LOG_OPACITY,
    ROW_DECAY,
    SEGMENT,
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
    """Writes the row buffer at `base` and returns the reached segments as bits.

    `left`, `top` are the tile's corner in pixels; row centres are relative to it and count from
    the middle of the first pixel.
    """
    half = splat(np.float32(0.5))
    u = (broadcast(records, record + U_WHOLE) - splat(left)) + (
        broadcast(records, record + U_PART) - half
    )
    v = (broadcast(records, record + V_WHOLE) - splat(top)) + (
        broadcast(records, record + V_PART) - half
    )
    slope = broadcast(records, record + SLOPE)
    row_decay = broadcast(records, record + ROW_DECAY)
    width = broadcast(records, record + WIDTH)
    log_opacity = broadcast(records, record + LOG_OPACITY)
    spare = splat(np.float32(SPARE - TOUCH))
    reached = np.uint64(0)
    for block in range(0, TILE_HEIGHT, LANES):
        dy = (ramp() + splat(np.float32(block))) - v
        exponent = fnma(row_decay * dy, dy, log_opacity)
        centre = fma(slope, dy, u)
        store(rows, base + ROW_CENTRE + block, centre)
        store(rows, base + ROW_EXPONENT + block, exponent)
        store(rows, base + ROW_DY + block, dy)
        # NaN in rows that the Gaussian does not reach; NaN passes no comparison.
        extent = square_root((exponent + spare) * width)
        first = round_up(centre - extent)
        last = round_down(centre + extent)
        row_reached = first <= last
        for column in range(COLUMNS):
            begin = splat(np.float32(column * SEGMENT))
            end = splat(np.float32(column * SEGMENT + SEGMENT - 1))
            inside = row_reached & (first <= end) & (last >= begin)
            reached |= bits(inside) << np.uint64(column * TILE_HEIGHT + block)
    return reached
