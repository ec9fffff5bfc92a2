"""Compositing of the tiles, front to back."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, take
from crossgrad_core.numerics.simd import (
    LANES,
    as_negative,
    bits,
    broadcast,
    count_bits,
    fma,
    fnma,
    load,
    lowest_bit,
    prefetch,
    smaller,
    splat,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.analytic import (
    axis_offsets,
    coverages,
    fill_axis_rows,
    near_enough,
)
from crossgrad_plugins.rasterizers.numba_kernels.constants import (
    LARGEST_ALPHA,
    LEAST,
    OFFSETS,
    STOPPED,
    TOUCHED,
    exp2,
)
from crossgrad_plugins.rasterizers.numba_kernels.footprint import (
    ROW_CENTRE,
    ROW_EXPONENT,
    ROWS,
    fill_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLUE,
    COLUMNS,
    COSINE,
    DECAY,
    DEPTH,
    GREEN,
    INVERSE_1,
    INVERSE_2,
    PEAK,
    RADIUS,
    RECORD,
    RED,
    SEGMENT,
    SEGMENTS,
    SINE,
    TILE_HEIGHT,
    TILE_WIDTH,
)

#: Entries whose reach is computed before any of them is blended: hides the latency of their
#: memory reads and row extents, and is how often finished segments are looked for.
BATCH = 16

# Side of the squares that limits count, pixels; the segments of one column of segments as bits.
_SQUARE = 16
_COLUMN = np.uint64((1 << TILE_HEIGHT) - 1)

# State of a segment: one vector each. The transmittance is negative once a pixel is finished.
# The depths of all segments follow the states of all segments.
_T, _RED, _GREEN, _BLUE = 0, LANES, 2 * LANES, 3 * LANES
_STATE = 4 * LANES
_DEPTHS = SEGMENTS * _STATE


@device
def _start(state: NDArray[np.float32], width: int, height: int) -> np.uint64:
    """Clears the state of a tile of width x height pixels; returns its segments as bits."""
    state[:] = np.float32(0.0)
    live = np.uint64(0)
    for segment in range(SEGMENTS):
        row = segment % TILE_HEIGHT
        first = (segment // TILE_HEIGHT) * SEGMENT
        for x in range(SEGMENT):
            inside = row < height and first + x < width
            state[segment * _STATE + _T + x] = np.float32(1.0 if inside else -1.0)
        if row < height and first < width:
            live |= np.uint64(1) << np.uint64(segment)
    return live


@device
def _within(limits: NDArray[np.int32], record: int, left: int) -> np.uint64:
    """Returns the segments of a tile, whose first column is `left`, within a record's limits."""
    inside = np.uint64(0)
    for column in range(COLUMNS):
        square = (left + column * SEGMENT) // _SQUARE
        if limits[record, 0] <= square <= limits[record, 1]:
            inside |= _COLUMN << np.uint64(column * TILE_HEIGHT)
    return inside


@device
def _unfinished(state: NDArray[np.float32], live: np.uint64) -> np.uint64:
    """Returns the live segments that still have an unfinished pixel."""
    rest = live
    while rest != np.uint64(0):
        segment = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        going = bits(load(state, segment * _STATE + _T) >= splat(np.float32(0.0)))
        live &= ~(np.uint64(going == np.uint64(0)) << np.uint64(segment))
    return live


@device
def _blend(
    reached: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    counts: NDArray[np.int32] | None,
    analytic: NDArray[np.float32] | None,
) -> tuple[int, np.uint64]:
    """Blends one Gaussian into the reached segments.

    Returns:
        The number of pixels blended, and the segments without those found to be out of reach.
    """
    left = reached
    decay = broadcast(records, record + DECAY)
    red = broadcast(records, record + RED)
    green = broadcast(records, record + GREEN)
    blue = broadcast(records, record + BLUE)
    z = broadcast(records, record + DEPTH)
    cosine, sine = broadcast(records, record + COSINE), broadcast(records, record + SINE)
    inverse_1 = broadcast(records, record + INVERSE_1)
    inverse_2 = broadcast(records, record + INVERSE_2)
    peak = broadcast(records, record + PEAK)
    squared = broadcast(records, record + RADIUS)
    zero = splat(np.float32(0.0))
    pixels = 0
    while reached != np.uint64(0):
        segment = lowest_bit(reached)
        reached &= reached - np.uint64(1)
        row = base + (segment & (TILE_HEIGHT - 1))
        at = segment * _STATE
        offsets = load(constants, OFFSETS + (segment // TILE_HEIGHT) * SEGMENT)
        if analytic is None:
            dx = offsets - broadcast(rows, row + ROW_CENTRE)
            power = fnma(decay * dx, dx, broadcast(rows, row + ROW_EXPONENT))
            touched = power >= load(constants, TOUCHED)
            alpha = exp2(power, constants)
        else:
            u, v = axis_offsets(cosine, sine, offsets, rows, row)
            if near_enough(u, v, inverse_1, inverse_2, squared) == np.uint64(0):
                left &= ~(np.uint64(1) << np.uint64(segment))
                continue
            alpha = coverages(peak, u, v, inverse_1, inverse_2, constants)
            touched = alpha >= load(constants, LEAST)
        # Where nothing is touched alpha may be anything, NaN included: select, never multiply.
        alpha = where(touched, smaller(alpha, load(constants, LARGEST_ALPHA)), zero)
        before = load(state, at + _T)
        weight = alpha * before
        after = before - weight
        blended = after >= load(constants, STOPPED)
        weight = where(blended, weight, zero)
        store(state, at + _T, where(blended, after, as_negative(before)))
        store(state, at + _RED, fma(weight, red, load(state, at + _RED)))
        store(state, at + _GREEN, fma(weight, green, load(state, at + _GREEN)))
        store(state, at + _BLUE, fma(weight, blue, load(state, at + _BLUE)))
        if depth is not None:
            spot = _DEPTHS + segment * LANES
            store(state, spot, fma(weight, z, load(state, spot)))
        if counts is not None:
            pixels += count_bits(bits(touched & blended))
    return pixels, left


@device
def _finish(
    state: NDArray[np.float32],
    top: int,
    left: int,
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
) -> None:
    """Adds the background and writes the tile's pixels."""
    for y in range(min(TILE_HEIGHT, image.shape[0] - top)):
        for x in range(min(TILE_WIDTH, image.shape[1] - left)):
            segment = (x // SEGMENT) * TILE_HEIGHT + y
            at = segment * _STATE + x % SEGMENT
            through = abs(state[at + _T])
            image[top + y, left + x, 0] = state[at + _RED] + through * background[0]
            image[top + y, left + x, 1] = state[at + _GREEN] + through * background[1]
            image[top + y, left + x, 2] = state[at + _BLUE] + through * background[2]
            alpha[top + y, left + x] = np.float32(1.0) - through
            if depth is not None:
                depth[top + y, left + x] = state[_DEPTHS + segment * LANES + x % SEGMENT]


@device
def _composite(
    tile: int,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    records: NDArray[np.float32],
    constants: NDArray[np.float32],
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    counts: NDArray[np.int32] | None,
    analytic: NDArray[np.float32] | None,
    limits: NDArray[np.int32] | None,
    masks: NDArray[np.uint64],
) -> None:
    """Composites one tile and leaves in `masks` the segments that each entry was blended into."""
    columns = (image.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    top = (tile // columns) * TILE_HEIGHT
    left = (tile % columns) * TILE_WIDTH
    state = np.empty(_DEPTHS + SEGMENTS * LANES, np.float32)
    rows = np.empty(BATCH * ROWS, np.float32)
    batch = np.empty(BATCH, np.int64)
    live = _start(state, image.shape[1] - left, image.shape[0] - top)
    entry, stop = starts[tile], starts[tile + 1]
    while entry < stop and live != np.uint64(0):
        end = min(entry + BATCH, stop)
        filled = 0
        for k in range(entry, end):
            prefetch(records, np.intp(entries[min(k + BATCH, stop - 1), 0]) * RECORD)
            record = np.intp(entries[k, 0]) * RECORD
            if analytic is None:
                reached = fill_rows(
                    records, record, np.float32(left), np.float32(top), rows, filled * ROWS
                )
            else:
                reached = fill_axis_rows(
                    records, record, np.float32(left), np.float32(top), rows, filled * ROWS
                )
            reached &= live
            if limits is not None:
                reached &= _within(limits, np.intp(entries[k, 0]), left)
            masks[k] = np.uint64(reached)
            batch[filled] = k
            # No branch: an entry that reaches nothing is overwritten by the next one.
            filled += np.intp(reached != np.uint64(0))
        for k in range(filled):
            record = np.intp(entries[batch[k], 0]) * RECORD
            reached = np.uint64(masks[batch[k]])
            pixels, masks[batch[k]] = _blend(
                reached, records, record, rows, k * ROWS, state, constants, depth, counts, analytic
            )
            if counts is not None:
                counts[entries[batch[k], 1]] = pixels
        live = _unfinished(state, live)
        entry = end
    _finish(state, top, left, background, image, alpha, depth)


@kernel
def composite(
    jobs: Jobs,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    records: NDArray[np.float32],
    constants: NDArray[np.float32],
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    counts: NDArray[np.int32] | None,
    analytic: NDArray[np.float32] | None,
    limits: NDArray[np.int32] | None,
    masks: NDArray[np.uint64],
) -> None:
    """Composites all tiles.

    Args:
        jobs: From `share`.
        starts: [T + 1] first entry of each tile.
        entries: [E, 2] records and slots of each tile, front to back.
        records: Records of the drawn Gaussians, flat.
        constants: From `vector_constants`.
        background: [3] RGB.
        image: [H, W, 3] written.
        alpha: [H, W] written.
        depth: [H, W] written, or None.
        counts: [slots] pixels blended per slot, written; zero before. None: not counted.
        analytic: Any vector says that the records are of the analytic response; None: plain.
        limits: [N, 2] first and last column of 16 pixels per record; None: no limits.
        masks: [E] segments per entry, written; zero before.
    """
    tile = take(jobs)
    while tile < starts.shape[0] - 1:
        _composite(
            tile,
            starts,
            entries,
            records,
            constants,
            background,
            image,
            alpha,
            depth,
            counts,
            analytic,
            limits,
            masks,
        )
        tile = take(jobs)
