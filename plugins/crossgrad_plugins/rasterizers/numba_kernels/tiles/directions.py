"""Gradients of single pixels with respect to a Gaussian's mean, and their directions.

This pass follows the backward pass if a densifier needs directions. It renders the tiles again, and
sums the fields of `crossgrad_core.contract.gaussians.Screen.directions` for each entry and bin.

The operations and their order are those of `backward`, so the gradients have the same bits. Only
operations for other sums are omitted.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    Mask,
    aligned,
    broadcast,
    broadcast_four_wide,
    broadcast_wide,
    first_half,
    fma,
    fnma,
    larger,
    last_half,
    load,
    load_wide,
    lowest_bit,
    magnitude,
    prefetch,
    ramp,
    smaller,
    splat,
    splat_wide,
    square_root,
    store,
    sums,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLUE,
    CAPPED,
    COSINE,
    DECAY,
    DEPTH,
    FIXED,
    GREEN,
    INVERSE_1,
    INVERSE_2,
    LARGEST_ALPHA,
    LEAST,
    MIDDLE,
    OFFSETS,
    PATCHES,
    PEAK,
    RECORD,
    RED,
    ROW_DECAY,
    SIDE,
    SINE,
    SLOPE,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCHED,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    exp2,
    terms_of,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import (
    axis_offsets,
    coverage_gradients,
    fill_axis_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.footprint import (
    ROW_CENTRE,
    ROW_DY,
    ROW_EXPONENT,
    ROWS,
    fill_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.pixel_states import (
    DEPTHS,
    STATE,
    V_BLUE,
    V_GREEN,
    V_RED,
    blend,
    column_of,
    odds_of,
    row_of,
    start_tile,
)

BINS, FIELDS = 6, 5
#: Number of sums per entry: the sums of all bins, and two unused numbers.
SUMS = 4 * LANES
#: Records are prefetched for entries this far ahead.
_AHEAD = 8
_SMALL, _UP = np.float32(2.0**-60), np.float32(2.0**90)
_LARGE, _DOWN = np.float32(2.0**60), np.float32(2.0**-66)


@device
def _add(binned: NDArray[np.float32], number: int, inside: Mask, value: Lanes) -> None:
    """Add the values of the pixels inside a bin to sum `number`."""
    at = number * LANES
    store(binned, at, load(binned, at) + where(inside, value, splat(np.float32(0.0))))


@device
def _bin(position: float) -> int:
    """Return the bin of a position along the longest axis."""
    return np.intp(min(max(np.floor(position), np.float32(-3.0)), np.float32(2.0))) + 3


@device
def _spread(
    gx: Lanes,
    gy: Lanes,
    along: Lanes,
    width: np.float32,
    height: np.float32,
    places: NDArray[np.float32],
    binned: NDArray[np.float32],
) -> None:
    """Add the gradients of two columns of four pixels to the sums of their bins.

    Args:
        gx: Gradients with respect to x of the projected mean, px^-1.
        gy: Gradients with respect to y of the projected mean, px^-1.
        along: Positions along the longest axis, in standard deviations.
        width: Width of the image, pixels, for the conversion to NDC units.
        height: Height of the image, pixels, for the conversion to NDC units.
        places: [LANES] buffer for `along`.
        binned: [BINS * FIELDS * LANES] sums of the bins.
    """
    one = splat(np.float32(1.0))
    hx, hy = gx * splat(width), gy * splat(height)
    largest = larger(magnitude(hx), magnitude(hy))
    moved = splat(np.float32(0.0)) < largest
    # Scale by powers of two, so that squares of any gradients are valid float32 numbers.
    scale = where(largest < splat(_SMALL), splat(_UP), one)
    scale = where(splat(_LARGE) < largest, splat(_DOWN), scale)
    hx, hy = hx * scale, hy * scale
    inverse = one / square_root(fma(hx, hx, hy * hy))
    hx, hy, gx, gy = hx * inverse, hy * inverse, magnitude(gx), magnitude(gy)
    # Positions along the axis are monotonic along rows and columns of pixels. The corners of a
    # patch therefore give the smallest and the largest bin.
    store(places, 0, along)
    a, b = _bin(places[0]), _bin(places[SIDE - 1])
    c, d = _bin(places[LANES - SIDE]), _bin(places[LANES - 1])
    for number in range(min(a, b, c, d), max(a, b, c, d) + 1):
        low = splat(np.float32(number - 3 if number > 0 else -np.inf))
        high = splat(np.float32(number - 2 if number < BINS - 1 else np.inf))
        inside = moved & (along >= low) & (along < high)
        _add(binned, number * FIELDS, inside, hx)
        _add(binned, number * FIELDS + 1, inside, hy)
        _add(binned, number * FIELDS + 2, inside, gx)
        _add(binned, number * FIELDS + 3, inside, gy)
        _add(binned, number * FIELDS + 4, inside, one)


@device
def _weighted_color(
    patch: int,
    records: NDArray[np.float32],
    record: int,
    state: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
) -> Lanes:
    """Return the gradients of a patch's pixels, times the colour of the Gaussian."""
    at = patch * STATE
    weighted_color = load_wide(state, at + V_RED) * broadcast_wide(records, record + RED)
    weighted_color = fma(
        load_wide(state, at + V_GREEN), broadcast_wide(records, record + GREEN), weighted_color
    )
    weighted_color = fma(
        load_wide(state, at + V_BLUE), broadcast_wide(records, record + BLUE), weighted_color
    )
    if v_depth is not None:
        v_z = load_wide(state, DEPTHS + patch * WIDE)
        weighted_color = fma(v_z, broadcast_wide(records, record + DEPTH), weighted_color)
    return weighted_color


@device
def mean_gradients(
    patch: int,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
) -> tuple[Lanes, Lanes]:
    """Blend a Gaussian into a patch, and return a gradient for each pixel.

    The gradient is with respect to x and y of the projected mean.

    For records of the plain response, the unit is 2 log 2 px^-1; for the analytic response, it is
    px^-1.
    """
    row = base + row_of(patch)
    offsets = load_wide(constants, OFFSETS + column_of(patch) * WIDE)
    zero = splat_wide(np.float32(0.0))
    if analytic is None:
        decay = broadcast_wide(records, record + DECAY)
        dx = offsets - broadcast_four_wide(rows, row + ROW_CENTRE)
        power = fnma(decay * dx, dx, broadcast_four_wide(rows, row + ROW_EXPONENT))
        touched = power >= load_wide(constants, TOUCHED)
        free = power <= load_wide(constants, CAPPED)
        alpha = exp2(power, terms_of(constants))
    else:
        cosine, sine = (
            broadcast_wide(records, record + COSINE),
            broadcast_wide(records, record + SINE),
        )
        inverse_1 = broadcast_wide(records, record + INVERSE_1)
        inverse_2 = broadcast_wide(records, record + INVERSE_2)
        peak = broadcast_wide(records, record + PEAK)
        u, v = axis_offsets(cosine, sine, offsets, rows, row)
        alpha, by_u, by_v, _, _ = coverage_gradients(peak, u, v, inverse_1, inverse_2, constants)
        touched = alpha >= load_wide(constants, LEAST)
        free = touched & (alpha <= load_wide(constants, LARGEST_ALPHA))
    alpha = where(touched, smaller(alpha, load_wide(constants, LARGEST_ALPHA)), zero)
    weighted_color = _weighted_color(patch, records, record, state, v_depth)
    odds = where(free, odds_of(alpha, constants), load_wide(constants, FIXED))
    _, s = blend(alpha, odds, constants, weighted_color, state, patch * STATE, constants)
    if analytic is None:
        sd = s * dx
        grad_y_slope = decay * broadcast_wide(records, record + SLOPE)
        decay_row = broadcast_wide(records, record + ROW_DECAY)
        grad_y_row = decay_row * broadcast_four_wide(rows, row + ROW_DY)
        return decay * sd, fnma(grad_y_slope, sd, grad_y_row * s)
    su = where(free, s * by_u * inverse_1, zero)
    sv = where(free, s * by_v * inverse_2, zero)
    return fnma(cosine, su, sine * sv), zero - fma(cosine, sv, sine * su)


@device
def _entry(
    reached: np.uint64,
    records: NDArray[np.float32],
    record: int,
    axes: NDArray[np.float32],
    axis: int,
    top: int,
    left: int,
    rows: NDArray[np.float32],
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    image: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
    places: NDArray[np.float32],
    binned: NDArray[np.float32],
    slot_sums: NDArray[np.float32],
    at: int,
) -> None:
    """Write the sums of one Gaussian over the reached patches of a tile to `slot_sums`."""
    half = splat(np.float32(0.5))
    axis_x, axis_y = broadcast(axes, axis), broadcast(axes, axis + 1)
    # In this function, pixel centres have whole-number coordinates, as in `fill_rows`.
    u = (broadcast(records, record + U_WHOLE) - splat(np.float32(left))) + (
        broadcast(records, record + U_PART) - half
    )
    v = (broadcast(records, record + V_WHOLE) - splat(np.float32(top))) + (
        broadcast(records, record + V_PART) - half
    )
    binned[:] = np.float32(0.0)
    width, height = np.float32(image.shape[1]), np.float32(image.shape[0])
    x = load(constants, OFFSETS) + splat(np.float32(MIDDLE))
    y = fnma(splat(np.float32(SIDE)), x, ramp())
    rest = reached
    while rest != np.uint64(0):
        patch = lowest_bit(rest)
        rest &= rest - np.uint64(1)
        gx, gy = mean_gradients(
            patch, records, record, rows, 0, state, constants, v_depth, analytic
        )
        dx = x + splat(np.float32(column_of(patch) * SIDE)) - u
        dy = y + splat(np.float32(row_of(patch))) - v
        along = fma(axis_x, dx, axis_y * dy)
        _spread(first_half(gx), first_half(gy), along, width, height, places, binned)
        # The second half of a patch's lanes is to the right of the first half.
        along = fma(axis_x, dx + splat(np.float32(SIDE // 2)), axis_y * dy)
        _spread(last_half(gx), last_half(gy), along, width, height, places, binned)
    for group in range(SUMS // LANES):
        first = group * LANES * LANES
        eight = sums(
            load(binned, first),
            load(binned, first + LANES),
            load(binned, first + 2 * LANES),
            load(binned, first + 3 * LANES),
            load(binned, first + 4 * LANES),
            load(binned, first + 5 * LANES),
            load(binned, first + 6 * LANES),
            load(binned, first + 7 * LANES),
        )
        store(slot_sums, at + group * LANES, eight)


@kernel
def bin_directions(
    jobs: Jobs,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    masks: NDArray[np.uint64],
    records: NDArray[np.float32],
    axes: NDArray[np.float32],
    constants: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
    found: NDArray[np.float32],
) -> None:
    """Sum the directions of every entry with a mask over the pixels of its tile.

    Args:
        jobs: Work queue from `share`.
        starts: [T + 1] index of the first entry of each tile.
        entries: [E, 2] record and slot of each entry.
        masks: [E] patches of each entry as bits.
        records: The records of the drawn Gaussians, flat.
        axes: [2 N] projected longest axis per record, from `longest_axes`, flat.
        constants: Constants from `vector_constants`.
        image: [H, W, 3] rendered image.
        alpha: [H, W] rendered accumulated opacity.
        depth: [H, W] rendered depth, or None.
        v_image: [H, W, 3] gradient with respect to the image.
        v_alpha: [H, W] gradient with respect to alpha, or None.
        v_depth: [H, W] gradient with respect to the depth, or None.
        analytic: An array with any content selects the analytic response; None selects the plain
            response.
        found: [slots * SUMS] output: sums for the slots of entries with a mask.
    """
    columns = (image.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    state = aligned(DEPTHS + PATCHES * WIDE)
    rows = np.empty(ROWS, np.float32)
    places = np.empty(LANES, np.float32)
    binned = np.empty(SUMS * LANES, np.float32)
    tiles = starts.shape[0] - 1
    tile = next_job(jobs, tiles)
    while tile < tiles:
        top = (tile // columns) * TILE_HEIGHT
        left = (tile % columns) * TILE_WIDTH
        start_tile(state, top, left, image, alpha, depth, v_image, v_alpha, v_depth)
        for entry in range(starts[tile], starts[tile + 1]):
            if masks[entry] == np.uint64(0):
                continue
            ahead = min(entry + _AHEAD, starts[tile + 1] - 1)
            prefetch(records, np.intp(entries[ahead, 0]) * RECORD)
            number = np.intp(entries[entry, 0])
            record = number * RECORD
            if analytic is None:
                fill_rows(records, record, np.float32(left), np.float32(top), rows, 0)
            else:
                fill_axis_rows(records, record, np.float32(left), np.float32(top), rows, 0)
            _entry(
                np.uint64(masks[entry]),
                records,
                record,
                axes,
                2 * number,
                top,
                left,
                rows,
                state,
                constants,
                image,
                v_depth,
                analytic,
                places,
                binned,
                found,
                np.intp(entries[entry, 1]) * SUMS,
            )
        tile = next_job(jobs, tiles)
