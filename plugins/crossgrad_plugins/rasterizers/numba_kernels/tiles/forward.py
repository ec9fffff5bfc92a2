"""Compositing of the pixels of tiles, from front to back."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    aligned,
    as_negative,
    bits,
    broadcast,
    broadcast_four_wide,
    broadcast_wide,
    count_bits,
    fma,
    fnma,
    load_wide,
    lowest_bit,
    magnitude,
    prefetch,
    ramp_wide,
    smaller,
    splat,
    splat_wide,
    store,
    store_triples,
    where,
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
    LARGEST_ALPHA,
    LEAST,
    MIDDLE,
    OFFSETS,
    PATCHES,
    PEAK,
    RADIUS,
    RECORD,
    RED,
    SIDE,
    SINE,
    STOPPED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCHED,
    exp2,
    terms_of,
)
from crossgrad_plugins.rasterizers.numba_kernels.records import SQUARE
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import (
    axis_offsets,
    coverages,
    fill_axis_rows,
    near_enough,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.footprint import (
    ROW_CENTRE,
    ROW_EXPONENT,
    ROWS,
    fill_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.pixel_states import (
    column_of,
    four_rows,
    place_of,
    row_of,
)

#: Number of entries whose reached patches are computed before the first entry is blended. A batch
#: of entries hides the waiting times of memory reads. Once per batch, patches whose pixels are all
#: finished are removed.
BATCH = 16

# Side length, in pixels, of the squares that `limits` counts, and the patches in the first column
# of squares as bits.
_SQUARE = int(SQUARE)
_ABREAST = np.uint64(
    sum(1 << patch for patch in range(PATCHES) if patch % COLUMNS < _SQUARE // SIDE)
)

# State of a patch, WIDE numbers each: transmittance (negative after a pixel is finished) and three
# colour channels. The depths of all patches follow after the states of all patches.
_T, _RED, _GREEN, _BLUE = 0, WIDE, 2 * WIDE, 3 * WIDE
_STATE = 4 * WIDE
_DEPTHS = PATCHES * _STATE


@device
def _start(
    state: NDArray[np.float32], width: int, height: int, constants: NDArray[np.float32]
) -> np.uint64:
    """Clear the state of a tile of width x height pixels; return its patches as bits."""
    state[:] = np.float32(0.0)
    live = np.uint64(0)
    x = load_wide(constants, OFFSETS) + splat_wide(np.float32(MIDDLE))
    y = fnma(splat_wide(np.float32(SIDE)), x, ramp_wide())
    one, finished = splat_wide(np.float32(1.0)), splat_wide(np.float32(-1.0))
    for patch in range(PATCHES):
        right, below = width - column_of(patch) * SIDE, height - row_of(patch)
        inside = (x < splat_wide(np.float32(right))) & (y < splat_wide(np.float32(below)))
        store(state, patch * _STATE + _T, where(inside, one, finished))
        live |= np.uint64((right > 0) & (below > 0)) << np.uint64(patch)
    return live


@device
def _within(limits: NDArray[np.int32], record: int, left: int) -> np.uint64:
    """Return the patches of a tile, whose first column is `left`, within a record's limits."""
    inside = np.uint64(0)
    for column in range(0, COLUMNS, _SQUARE // SIDE):
        square = (left + column * SIDE) // _SQUARE
        if limits[record, 0] <= square <= limits[record, 1]:
            inside |= _ABREAST << np.uint64(column)
    return inside


@device
def _unfinished(state: NDArray[np.float32], live: np.uint64) -> np.uint64:
    """Return the active patches that still contain an unfinished pixel."""
    rest = live
    going = np.uint64(0)
    while rest != np.uint64(0):
        patch = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        passed = load_wide(state, patch * _STATE + _T)
        left = bits(passed >= splat_wide(np.float32(0.0))) != np.uint64(0)
        going |= np.uint64(left) << np.uint64(patch)
    return going


@device
def _coverage(
    left: np.uint64,
    patch: int,
    offsets: Lanes,
    rows: NDArray[np.float32],
    row: int,
    records: NDArray[np.float32],
    record: int,
    constants: NDArray[np.float32],
) -> tuple[Lanes, np.uint64]:
    """Compute the analytic response in a patch.

    Returns: Alpha, and the bits `left`; the bit of the patch is cleared if the Gaussian does not
    reach it.
    """
    cosine, sine = broadcast_wide(records, record + COSINE), broadcast_wide(records, record + SINE)
    inverse_1 = broadcast_wide(records, record + INVERSE_1)
    inverse_2 = broadcast_wide(records, record + INVERSE_2)
    peak = broadcast_wide(records, record + PEAK)
    squared = broadcast_wide(records, record + RADIUS)
    u, v = axis_offsets(cosine, sine, offsets, rows, row)
    near = near_enough(u, v, inverse_1, inverse_2, squared)
    if near == np.uint64(0):
        return splat_wide(np.float32(0.0)), left & ~(np.uint64(1) << np.uint64(patch))
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
    """Blend one Gaussian into the patches that it reaches.

    Returns:
        The number of blended pixels, and the patches
        that the Gaussian reaches.
    """
    left = rest = reached
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
    while rest != np.uint64(0):
        patch = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        row, at = base + row_of(patch), patch * _STATE
        offsets = load_wide(constants, OFFSETS + column_of(patch) * WIDE)
        if analytic is None:
            dx = offsets - broadcast_four_wide(rows, row + ROW_CENTRE)
            power = fnma(decay * dx, dx, broadcast_four_wide(rows, row + ROW_EXPONENT))
            touched = power >= least
            alpha = exp2(power, terms)
        else:
            alpha, left = _coverage(left, patch, offsets, rows, row, records, record, constants)
            touched = alpha >= least
        # If a pixel is not touched, alpha is undefined and may be NaN. Select values by a mask,
        # because a multiplication by 0 would keep the NaN.
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
            spot = _DEPTHS + patch * WIDE
            store(state, spot, fma(weight, z, load_wide(state, spot)))
        if counts is not None:
            pixels += count_bits(bits(touched & blended))
    return pixels, left


@device
def _finish_row(
    passed: Lanes,
    red: Lanes,
    green: Lanes,
    blue: Lanes,
    pixel: int,
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
) -> None:
    """Add the background to eight pixels, and write them from a flat index on."""
    through = magnitude(passed)
    store_triples(
        image,
        3 * pixel,
        red + through * broadcast(background, 0),
        green + through * broadcast(background, 1),
        blue + through * broadcast(background, 2),
    )
    store(alpha, pixel, splat(np.float32(1.0)) - through)


@device
def _finish_two(
    state: NDArray[np.float32],
    patch: int,
    pixel: int,
    background: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
) -> None:
    """Write a patch and its right neighbour; their pixels begin at a flat index."""
    at, width = patch * _STATE, image.shape[1]
    t = _rows_at(state, at + _T, _STATE)
    r = _rows_at(state, at + _RED, _STATE)
    g = _rows_at(state, at + _GREEN, _STATE)
    b = _rows_at(state, at + _BLUE, _STATE)
    _finish_row(t[0], r[0], g[0], b[0], pixel, background, image, alpha)
    _finish_row(t[1], r[1], g[1], b[1], pixel + width, background, image, alpha)
    _finish_row(t[2], r[2], g[2], b[2], pixel + 2 * width, background, image, alpha)
    _finish_row(t[3], r[3], g[3], b[3], pixel + 3 * width, background, image, alpha)
    if depth is not None:
        z = _rows_at(state, _DEPTHS + patch * WIDE, WIDE)
        store(depth, pixel, z[0])
        store(depth, pixel + width, z[1])
        store(depth, pixel + 2 * width, z[2])
        store(depth, pixel + 3 * width, z[3])


@device
def _rows_at(state: NDArray[np.float32], at: int, ahead: int) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Return the pixel rows of a patch and of the patch that is `ahead` floats later."""
    return four_rows(load_wide(state, at), load_wide(state, at + ahead))


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
    """Add the background, and write the pixels of a tile."""
    width = image.shape[1]
    high, wide = min(TILE_HEIGHT, image.shape[0] - top), min(TILE_WIDTH, width - left)
    # Write pairs of complete patches first, then the remaining pixels one by one.
    whole_high, whole_wide = high - high % SIDE, wide - wide % LANES
    for y in range(0, whole_high, SIDE):
        for x in range(0, whole_wide, LANES):
            patch, _ = place_of(x, y)
            pixel = (top + y) * width + left + x
            _finish_two(state, patch, pixel, background, image, alpha, depth)
    for y in range(high):
        for x in range(whole_wide if y < whole_high else 0, wide):
            patch, lane = place_of(x, y)
            at = patch * _STATE + lane
            through = abs(state[at + _T])
            image[top + y, left + x, 0] = state[at + _RED] + through * background[0]
            image[top + y, left + x, 1] = state[at + _GREEN] + through * background[1]
            image[top + y, left + x, 2] = state[at + _BLUE] + through * background[2]
            alpha[top + y, left + x] = np.float32(1.0) - through
            if depth is not None:
                depth[top + y, left + x] = state[_DEPTHS + patch * WIDE + lane]


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
    """Composite one tile, and write to `masks` the patches in which each entry was blended."""
    columns = (image.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    top = (tile // columns) * TILE_HEIGHT
    left = (tile % columns) * TILE_WIDTH
    state = aligned(_DEPTHS + PATCHES * WIDE)
    rows = aligned(BATCH * ROWS)
    batch = np.empty(BATCH, np.int64)
    live = _start(state, image.shape[1] - left, image.shape[0] - top, constants)
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
            # Write every entry, because a test would be a branch. If an entry reaches no patch, the
            # next entry overwrites it.
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
    """Composite all tiles.

    Args:
        jobs: Work queue from `share`.
        starts: [T + 1] index of the first entry of each tile.
        entries: [E, 2] record and slot of each entry, from front to back within a tile.
        records: The records of the drawn Gaussians, flat.
        constants: Constants from `vector_constants`.
        background: [3] RGB of the background.
        image: [H, W, 3] output: the image.
        alpha: [H, W] output: accumulated opacity.
        depth: [H, W] output: depth; None if not needed.
        counts: [slots] output: number of blended pixels per slot; must be zero at the start. If
            None, pixels are not counted.
        analytic: An array with any content selects records of the analytic response; None selects
            the plain response.
        limits: [N, 2] first and last column of 16 pixels per record; None for no limits.
        masks: [E] output: patches of each entry as bits; must be zero at the start.
    """
    tiles = starts.shape[0] - 1
    tile = next_job(jobs, tiles)
    while tile < tiles:
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
        tile = next_job(jobs, tiles)
