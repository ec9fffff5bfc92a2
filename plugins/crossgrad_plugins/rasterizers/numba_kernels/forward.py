"""Compositing of the tiles, front to back."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, take
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    as_negative,
    bits,
    broadcast,
    broadcast_two_wide,
    broadcast_wide,
    count_bits,
    fma,
    fnma,
    interleaved,
    load_wide,
    lowest_bit,
    magnitude,
    prefetch,
    ramp,
    smaller,
    splat,
    splat_wide,
    store,
    store_triples,
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
    terms_of,
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
    PAIR,
    PEAK,
    RADIUS,
    RECORD,
    RED,
    SEGMENT,
    SEGMENTS,
    SINE,
    TILE_HEIGHT,
    TILE_WIDTH,
    UPPER,
)
from crossgrad_plugins.rasterizers.numba_kernels.segments import aligned, half_of, lane_of, upper_of

#: Entries whose reach is computed before any of them is blended: hides the latency of their
#: memory reads and row extents, and is how often finished segments are looked for.
BATCH = 16

# Side of the squares that limits count, pixels; the segments of one column of segments as bits.
_SQUARE = 16
_COLUMN = np.uint64((1 << TILE_HEIGHT) - 1)

# State of a pair of segments, WIDE numbers each: transmittance (negative once a pixel is finished)
# and three channels. The depths of all pairs follow the states of all pairs.
_T, _RED, _GREEN, _BLUE = 0, WIDE, 2 * WIDE, 3 * WIDE
_STATE = 4 * WIDE
_DEPTHS = SEGMENTS // 2 * _STATE


@device
def _start(state: NDArray[np.float32], width: int, height: int) -> np.uint64:
    """Clears the state of a tile of width x height pixels; returns its segments as bits."""
    state[:] = np.float32(0.0)
    live = np.uint64(0)
    columns = interleaved(ramp(), ramp())
    one, finished = splat_wide(np.float32(1.0)), splat_wide(np.float32(-1.0))
    for segment in range(0, SEGMENTS, 2):
        row = segment % TILE_HEIGHT
        left = min(width - (segment // TILE_HEIGHT) * SEGMENT, SEGMENT)
        upper, lower = left if row < height else 0, left if row + 1 < height else 0
        inside = columns < interleaved(splat(np.float32(upper)), splat(np.float32(lower)))
        store(state, segment * (_STATE // 2) + _T, where(inside, one, finished))
        both = np.uint64(upper > 0) | (np.uint64(lower > 0) << np.uint64(1))
        live |= both << np.uint64(segment)
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
    rest = upper_of(live)
    going = np.uint64(0)
    while rest != np.uint64(0):
        segment = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        passed = load_wide(state, segment * (_STATE // 2) + _T)
        pixels = bits(passed >= splat_wide(np.float32(0.0)))
        upper, lower = (pixels & np.uint64(UPPER)) != 0, (pixels & ~np.uint64(UPPER)) != 0
        going |= (np.uint64(upper) | (np.uint64(lower) << np.uint64(1))) << np.uint64(segment)
    return live & going


@device
def _coverage(
    left: np.uint64,
    segment: int,
    offsets: Lanes,
    rows: NDArray[np.float32],
    row: int,
    records: NDArray[np.float32],
    record: int,
    constants: NDArray[np.float32],
) -> tuple[Lanes, np.uint64]:
    """The analytic response in a pair of segments.

    Returns:
        Alpha, and `left` without those of the two segments that are out of reach.
    """
    cosine, sine = broadcast_wide(records, record + COSINE), broadcast_wide(records, record + SINE)
    inverse_1 = broadcast_wide(records, record + INVERSE_1)
    inverse_2 = broadcast_wide(records, record + INVERSE_2)
    peak = broadcast_wide(records, record + PEAK)
    squared = broadcast_wide(records, record + RADIUS)
    u, v = axis_offsets(cosine, sine, offsets, rows, row)
    near = near_enough(u, v, inverse_1, inverse_2, squared)
    if near & np.uint64(UPPER) == np.uint64(0):
        left &= ~(np.uint64(1) << np.uint64(segment))
    if near & ~np.uint64(UPPER) == np.uint64(0):
        left &= ~(np.uint64(2) << np.uint64(segment))
    if (left >> np.uint64(segment)) & np.uint64(3) == np.uint64(0):
        return splat_wide(np.float32(0.0)), left
    return coverages(peak, u, v, inverse_1, inverse_2, constants), left


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
    """Blends one Gaussian into the reached segments, in pairs.

    The other segment of a pair is left as it is: none of its pixels is touched, or all are done.

    Returns:
        The number of pixels blended, and the segments without those found to be out of reach.
    """
    left = reached
    pairs = upper_of(reached)
    decay = broadcast_wide(records, record + DECAY)
    red = broadcast_wide(records, record + RED)
    green = broadcast_wide(records, record + GREEN)
    blue = broadcast_wide(records, record + BLUE)
    z = broadcast_wide(records, record + DEPTH)
    terms = terms_of(constants)
    most, stopped = load_wide(constants, LARGEST_ALPHA), load_wide(constants, STOPPED)
    least = load_wide(constants, TOUCHED if analytic is None else LEAST)
    zero = splat_wide(np.float32(0.0))
    pixels = 0
    while pairs != np.uint64(0):
        segment = lowest_bit(pairs)
        pairs &= pairs - np.uint64(1)
        row = base + (segment & (TILE_HEIGHT - 1))
        at = segment * (_STATE // 2)
        offsets = load_wide(constants, OFFSETS + (segment // TILE_HEIGHT) * PAIR)
        if analytic is None:
            dx = offsets - broadcast_two_wide(rows, row + ROW_CENTRE)
            power = fnma(decay * dx, dx, broadcast_two_wide(rows, row + ROW_EXPONENT))
            touched = power >= least
            alpha = exp2(power, terms)
        else:
            alpha, left = _coverage(left, segment, offsets, rows, row, records, record, constants)
            touched = alpha >= least
        # Where nothing is touched alpha may be anything, NaN included: select, never multiply.
        alpha = where(touched, smaller(alpha, most), zero)
        before = load_wide(state, at + _T)
        weight = alpha * before
        after = before - weight
        blended = after >= stopped
        weight = where(blended, weight, zero)
        store(state, at + _T, where(blended, after, as_negative(before)))
        store(state, at + _RED, fma(weight, red, load_wide(state, at + _RED)))
        store(state, at + _GREEN, fma(weight, green, load_wide(state, at + _GREEN)))
        store(state, at + _BLUE, fma(weight, blue, load_wide(state, at + _BLUE)))
        if depth is not None:
            spot = _DEPTHS + segment * LANES
            store(state, spot, fma(weight, z, load_wide(state, spot)))
        if counts is not None:
            pixels += count_bits(bits(touched & blended))
    return pixels, left


@device
def _finish_segment(
    state: NDArray[np.float32],
    segment: int,
    pixel: int,
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
) -> None:
    """Adds the background to a segment and writes it to the pixels from a flat index on."""
    at = (segment >> 1) * _STATE
    through = magnitude(half_of(segment, load_wide(state, at + _T)))
    store_triples(
        image,
        3 * pixel,
        half_of(segment, load_wide(state, at + _RED)) + through * broadcast(background, 0),
        half_of(segment, load_wide(state, at + _GREEN)) + through * broadcast(background, 1),
        half_of(segment, load_wide(state, at + _BLUE)) + through * broadcast(background, 2),
    )
    store(alpha, pixel, splat(np.float32(1.0)) - through)
    if depth is not None:
        both = load_wide(state, _DEPTHS + (segment >> 1) * WIDE)
        store(depth, pixel, half_of(segment, both))


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
    width = image.shape[1]
    for y in range(min(TILE_HEIGHT, image.shape[0] - top)):
        inside = min(TILE_WIDTH, width - left)
        for column in range(inside // SEGMENT):
            pixel = (top + y) * width + left + column * SEGMENT
            segment = column * TILE_HEIGHT + y
            _finish_segment(state, segment, pixel, background, image, alpha, depth)
        # A segment that the image cuts.
        for x in range(inside - inside % SEGMENT, inside):
            segment = (x // SEGMENT) * TILE_HEIGHT + y
            lane = lane_of(segment, x % SEGMENT)
            at = (segment >> 1) * _STATE + lane
            through = abs(state[at + _T])
            image[top + y, left + x, 0] = state[at + _RED] + through * background[0]
            image[top + y, left + x, 1] = state[at + _GREEN] + through * background[1]
            image[top + y, left + x, 2] = state[at + _BLUE] + through * background[2]
            alpha[top + y, left + x] = np.float32(1.0) - through
            if depth is not None:
                depth[top + y, left + x] = state[_DEPTHS + (segment >> 1) * WIDE + lane]


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
    state = aligned(_DEPTHS + SEGMENTS * LANES)
    rows = aligned(BATCH * ROWS)
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
