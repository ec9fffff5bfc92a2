"""The number of marked pixels in which each Gaussian of a rendered view was blended.

This pass follows a render, for callers that can mark pixels only after they have seen the render.
It uses the tile lists of the forward pass, and repeats the blending without colours, in the patches
that contain a marked pixel. Its operations and decisions are those of `forward`.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    WIDE,
    aligned,
    bits,
    broadcast_four_wide,
    broadcast_wide,
    count_bits,
    fnma,
    load_wide,
    lowest_bit,
    prefetch,
    smaller,
    splat_wide,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COSINE,
    DECAY,
    INVERSE_1,
    INVERSE_2,
    LARGEST_ALPHA,
    LEAST,
    OFFSETS,
    PATCHES,
    PEAK,
    RECORD,
    SINE,
    STOPPED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCHED,
    exp2,
    terms_of,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import (
    axis_offsets,
    coverages,
    fill_axis_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.footprint import (
    ROW_CENTRE,
    ROW_EXPONENT,
    ROWS,
    fill_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.pixel_states import (
    column_of,
    place_of,
    row_of,
)

#: Records are prefetched for entries this far ahead.
_AHEAD = 8


@device
def _start(state: NDArray[np.float32], marked: NDArray[np.uint8], top: int, left: int) -> np.uint64:
    """Write the transmittances of a tile: 1 in marked pixels, -1 in all other pixels.

    Returns:
        The patches with a marked pixel, as bits.
    """
    state[:] = np.float32(-1.0)
    live = np.uint64(0)
    for y in range(min(TILE_HEIGHT, marked.shape[0] - top)):
        for x in range(min(TILE_WIDTH, marked.shape[1] - left)):
            if marked[top + y, left + x] != 0:
                patch, lane = place_of(x, y)
                state[patch * WIDE + lane] = np.float32(1.0)
                live |= np.uint64(1) << np.uint64(patch)
    return live


@device
def _count(
    reached: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    analytic: NDArray[np.float32] | None,
) -> int:
    """Blend one Gaussian into the patches that it reaches; return the number of blended pixels."""
    decay = broadcast_wide(records, record + DECAY)
    cosine, sine = broadcast_wide(records, record + COSINE), broadcast_wide(records, record + SINE)
    inverse_1 = broadcast_wide(records, record + INVERSE_1)
    inverse_2 = broadcast_wide(records, record + INVERSE_2)
    peak = broadcast_wide(records, record + PEAK)
    zero = splat_wide(np.float32(0.0))
    terms = terms_of(constants)
    pixels = 0
    rest = reached
    while rest != np.uint64(0):
        patch = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        row = row_of(patch)
        offsets = load_wide(constants, OFFSETS + column_of(patch) * WIDE)
        if analytic is None:
            dx = offsets - broadcast_four_wide(rows, row + ROW_CENTRE)
            power = fnma(decay * dx, dx, broadcast_four_wide(rows, row + ROW_EXPONENT))
            touched = power >= load_wide(constants, TOUCHED)
            alpha = exp2(power, terms)
        else:
            u, v = axis_offsets(cosine, sine, offsets, rows, row)
            alpha = coverages(peak, u, v, inverse_1, inverse_2, constants)
            touched = alpha >= load_wide(constants, LEAST)
        alpha = where(touched, smaller(alpha, load_wide(constants, LARGEST_ALPHA)), zero)
        before = load_wide(state, patch * WIDE)
        after = before - alpha * before
        # Transmittance never increases. A pixel that is finished or not marked is therefore not
        # blended again.
        store(state, patch * WIDE, after)
        pixels += count_bits(bits(touched & (after >= load_wide(constants, STOPPED))))
    return pixels


@kernel
def count_marked(
    jobs: Jobs,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    masks: NDArray[np.uint64],
    records: NDArray[np.float32],
    constants: NDArray[np.float32],
    marked: NDArray[np.uint8],
    analytic: NDArray[np.float32] | None,
    counts: NDArray[np.int32],
) -> None:
    """Count for each entry the marked pixels of its tile in which the entry was blended.

    Args:
        jobs: Work queue from `share`.
        starts: [T + 1] index of the first entry of each tile.
        entries: [E, 2] record and slot of each entry, from front to back within a tile.
        masks: [E] patches of each entry as bits, from the forward pass.
        records: The records of the drawn Gaussians, flat.
        constants: Constants from `vector_constants`.
        marked: [H, W] non-zero for pixels that count.
        analytic: An array with any content selects the analytic response; None selects the plain
            response.
        counts: [slots] output; must be zero at the start.
    """
    columns = (marked.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    state = aligned(PATCHES * WIDE)
    rows = np.empty(ROWS, np.float32)
    tiles = starts.shape[0] - 1
    tile = next_job(jobs, tiles)
    while tile < tiles:
        top, left = (tile // columns) * TILE_HEIGHT, (tile % columns) * TILE_WIDTH
        live = _start(state, marked, top, left)
        entry, stop = starts[tile], starts[tile + 1]
        while entry < stop and live != np.uint64(0):
            reached = np.uint64(masks[entry]) & live
            if reached != np.uint64(0):
                prefetch(records, np.intp(entries[min(entry + _AHEAD, stop - 1), 0]) * RECORD)
                record = np.intp(entries[entry, 0]) * RECORD
                if analytic is None:
                    fill_rows(records, record, np.float32(left), np.float32(top), rows, 0)
                else:
                    fill_axis_rows(records, record, np.float32(left), np.float32(top), rows, 0)
                counts[entries[entry, 1]] = _count(
                    reached, records, record, rows, state, constants, analytic
                )
            entry += 1
        tile = next_job(jobs, tiles)
