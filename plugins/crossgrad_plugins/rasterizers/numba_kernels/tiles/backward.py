"""Gradients of the pixels, summed per Gaussian and tile, from front to back.

Let S be the part of the linearised loss that comes from all Gaussians behind the current one. At
the start, S is the gradient of the pixel times the value of the pixel. Let c be the gradient of the
pixel times the colour of the Gaussian, and T the transmittance. Then the derivative of the loss L
is

    dL/d(alpha) = T c - S / (1 - alpha).

One pass from front to back is therefore enough, and T has the same bits as in the forward pass. A
gradient with respect to the accumulated opacity only changes the start value of S: this gradient
times the final transmittance is subtracted. The accumulated depth is treated like a fourth colour
channel.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    aligned,
    broadcast,
    broadcast_four,
    broadcast_four_wide,
    broadcast_wide,
    fma,
    fnma,
    halves_added,
    load,
    load_wide,
    lowest_bit,
    magnitude,
    prefetch,
    prefetch_write,
    smaller,
    splat,
    splat_wide,
    store,
    sums,
    total,
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
    LOG_OPACITY,
    OFFSETS,
    PARTIAL,
    PATCHES,
    PEAK,
    RECORD,
    RED,
    ROW_DECAY,
    SINE,
    SLOPE,
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_BLUE,
    SUM_DEPTH,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCHED,
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

#: Values of a patch, WIDE numbers each: alpha, and the odds alpha / (1 - alpha). Later, the
#: gradient with respect to the exponent replaces alpha.
_ALPHA, _ODDS = 0, WIDE
_RESPONSE = 2 * WIDE

#: Number of entries whose row buffers are filled before the first entry is processed.
BATCH = 8


@device
def _respond(
    patches: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    constants: NDArray[np.float32],
    capped: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
) -> None:
    """Write alpha and odds of the plain response for several patches.

    This loop is separate, because alpha does not depend on the transmittance that earlier Gaussians
    leave. The processor can therefore work on several patches at the same time.
    """
    decay = broadcast_wide(records, record + DECAY)
    terms = terms_of(constants)
    zero = splat_wide(np.float32(0.0))
    at = 0
    while patches != np.uint64(0):
        patch = lowest_bit(patches)
        patches &= patches - np.uint64(1)
        row = base + row_of(patch)
        offsets = load_wide(constants, OFFSETS + column_of(patch) * WIDE)
        dx = offsets - broadcast_four_wide(rows, row + ROW_CENTRE)
        power = fnma(decay * dx, dx, broadcast_four_wide(rows, row + ROW_EXPONENT))
        touched = power >= load_wide(constants, TOUCHED)
        # If a pixel is not touched, alpha is undefined and may be NaN. Select values by a mask,
        # because a multiplication by 0 would keep the NaN.
        alpha = smaller(exp2(power, terms), load_wide(constants, LARGEST_ALPHA))
        alpha = where(touched, alpha, zero)
        store(responses, at + _ALPHA, alpha)
        if capped is not None:
            odds = odds_of(alpha, constants)
            odds = where(power <= load_wide(constants, CAPPED), odds, load_wide(constants, FIXED))
            store(responses, at + _ODDS, odds)
        at += _RESPONSE


@device
def _blend(
    patches: np.uint64,
    records: NDArray[np.float32],
    record: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    capped: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Blend a Gaussian of the plain response into patches.

    Alpha is replaced by the gradient with respect to the exponent.

    Returns:
        The sums of the gradients with respect to red, green, blue and depth.
    """
    red = broadcast_wide(records, record + RED)
    green = broadcast_wide(records, record + GREEN)
    blue = broadcast_wide(records, record + BLUE)
    z = broadcast_wide(records, record + DEPTH)
    sum_red = sum_green = sum_blue = sum_depth = splat_wide(np.float32(0.0))
    response = 0
    while patches != np.uint64(0):
        patch = lowest_bit(patches)
        patches &= patches - np.uint64(1)
        at = patch * STATE
        alpha = load_wide(responses, response + _ALPHA)
        if capped is None:
            odds = odds_of(alpha, constants)
        else:
            odds = load_wide(responses, response + _ODDS)
        v_red = load_wide(state, at + V_RED)
        v_green = load_wide(state, at + V_GREEN)
        v_blue = load_wide(state, at + V_BLUE)
        weighted_color = fma(v_blue, blue, fma(v_green, green, v_red * red))
        if v_depth is not None:
            v_z = load_wide(state, DEPTHS + patch * WIDE)
            weighted_color = fma(v_z, z, weighted_color)
        weight, s = blend(alpha, odds, capped, weighted_color, state, at, constants)
        store(responses, response + _ALPHA, s)
        response += _RESPONSE
        sum_red = fma(weight, v_red, sum_red)
        sum_green = fma(weight, v_green, sum_green)
        sum_blue = fma(weight, v_blue, sum_blue)
        if v_depth is not None:
            sum_depth = fma(weight, v_z, sum_depth)
    return sum_red, sum_green, sum_blue, sum_depth


@device
def _moments(
    patches: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    constants: NDArray[np.float32],
    absolute: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]:
    """Return SUM_1, SUM_D, SUM_Y, SUM_DD, SUM_YY, SUM_DY, SUM_ABS_X and SUM_ABS_Y in eight lanes.

    Both halves of a patch's lanes belong to the same pixel rows and have equal dy, so they are
    added before the multiplication by dy. Afterwards, six sums of eight lanes fit into sixteen
    vector registers.
    """
    # d(exponent)/d(mean y) = log 2 (2 row_decay dy - 2 slope decay dx)
    decay_row = broadcast(records, record + ROW_DECAY)
    grad_y_slope = broadcast(records, record + DECAY) * broadcast(records, record + SLOPE)
    sum_1 = sum_d = sum_y = sum_dd = sum_yy = sum_dy = splat(np.float32(0.0))
    sum_abs_x = sum_abs_y = splat(np.float32(0.0))
    response = 0
    while patches != np.uint64(0):
        patch = lowest_bit(patches)
        patches &= patches - np.uint64(1)
        row, column = base + row_of(patch), OFFSETS + column_of(patch) * WIDE
        first = load(responses, response + _ALPHA)
        second = load(responses, response + _ALPHA + LANES)
        response += _RESPONSE
        centre = broadcast_four(rows, row + ROW_CENTRE)
        first_dx = load(constants, column) - centre
        second_dx = load(constants, column + LANES) - centre
        dy = broadcast_four(rows, row + ROW_DY)
        first_d, second_d = first * first_dx, second * second_dx
        s, sd = first + second, first_d + second_d
        sy = s * dy
        sum_1 = sum_1 + s
        sum_d = sum_d + sd
        sum_y = sum_y + sy
        sum_dd = fma(second_d, second_dx, fma(first_d, first_dx, sum_dd))
        sum_yy = fma(sy, dy, sum_yy)
        sum_dy = fma(sd, dy, sum_dy)
        if absolute is not None:
            sum_abs_x = sum_abs_x + (magnitude(first_d) + magnitude(second_d))
            grad_y_row = decay_row * dy
            sum_abs_y = sum_abs_y + magnitude(fnma(grad_y_slope, first_d, grad_y_row * first))
            sum_abs_y = sum_abs_y + magnitude(fnma(grad_y_slope, second_d, grad_y_row * second))
    return sum_1, sum_d, sum_y, sum_dd, sum_yy, sum_dy, sum_abs_x, sum_abs_y


@device
def _gather(
    patches: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    absolute: NDArray[np.float32] | None,
    capped: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
    partials: NDArray[np.float32],
    partial: int,
) -> None:
    """Sum the gradients of one Gaussian (plain response) over patches into `partials`.

    `capped` is None if the Gaussian's alpha reaches the cap in no pixel.
    """
    _respond(patches, records, record, rows, base, constants, capped, responses)
    sum_red, sum_green, sum_blue, sum_depth = _blend(
        patches, records, record, state, constants, v_depth, capped, responses
    )
    sum_1, sum_d, sum_y, sum_dd, sum_yy, sum_dy, sum_abs_x, sum_abs_y = _moments(
        patches, records, record, rows, base, constants, absolute, responses
    )
    # Keep the order of the fields in the layout.
    red, green = halves_added(sum_red), halves_added(sum_green)
    store(partials, partial, sums(sum_1, sum_d, sum_y, sum_dd, sum_yy, sum_dy, red, green))
    partials[partial + SUM_BLUE] = total(halves_added(sum_blue))
    if v_depth is not None:
        partials[partial + SUM_DEPTH] = total(halves_added(sum_depth))
    if absolute is not None:
        partials[partial + SUM_ABS_X] = total(sum_abs_x)
        partials[partial + SUM_ABS_Y] = total(sum_abs_y)


@device
def _gather_analytic(
    patches: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    absolute: NDArray[np.float32] | None,
    partials: NDArray[np.float32],
    partial: int,
) -> None:
    """Sum the gradients of one Gaussian over patches, for the analytic response."""
    red = broadcast_wide(records, record + RED)
    green = broadcast_wide(records, record + GREEN)
    blue = broadcast_wide(records, record + BLUE)
    z = broadcast_wide(records, record + DEPTH)
    cosine, sine = broadcast_wide(records, record + COSINE), broadcast_wide(records, record + SINE)
    inverse_1 = broadcast_wide(records, record + INVERSE_1)
    inverse_2 = broadcast_wide(records, record + INVERSE_2)
    peak = broadcast_wide(records, record + PEAK)
    zero = splat_wide(np.float32(0.0))
    sum_1 = sum_u = sum_v = sum_sigma_1 = sum_sigma_2 = sum_turn = zero
    sum_red = sum_green = sum_blue = sum_depth = sum_abs_x = sum_abs_y = zero
    while patches != np.uint64(0):
        patch = lowest_bit(patches)
        patches &= patches - np.uint64(1)
        row = base + row_of(patch)
        at = patch * STATE
        offsets = load_wide(constants, OFFSETS + column_of(patch) * WIDE)
        u, v = axis_offsets(cosine, sine, offsets, rows, row)
        alpha, by_u, by_v, by_sigma_1, by_sigma_2 = coverage_gradients(
            peak, u, v, inverse_1, inverse_2, constants
        )
        touched = alpha >= load_wide(constants, LEAST)
        free = touched & (alpha <= load_wide(constants, LARGEST_ALPHA))
        alpha = where(touched, smaller(alpha, load_wide(constants, LARGEST_ALPHA)), zero)
        odds = where(free, odds_of(alpha, constants), load_wide(constants, FIXED))
        v_red = load_wide(state, at + V_RED)
        v_green = load_wide(state, at + V_GREEN)
        v_blue = load_wide(state, at + V_BLUE)
        weighted_color = fma(v_blue, blue, fma(v_green, green, v_red * red))
        if v_depth is not None:
            v_z = load_wide(state, DEPTHS + patch * WIDE)
            weighted_color = fma(v_z, z, weighted_color)
        weight, s = blend(alpha, odds, constants, weighted_color, state, at, constants)
        sum_red = fma(weight, v_red, sum_red)
        sum_green = fma(weight, v_green, sum_green)
        sum_blue = fma(weight, v_blue, sum_blue)
        if v_depth is not None:
            sum_depth = fma(weight, v_z, sum_depth)
        su = where(free, s * by_u * inverse_1, zero)
        sv = where(free, s * by_v * inverse_2, zero)
        sum_1 = sum_1 + s
        sum_u = sum_u + su
        sum_v = sum_v + sv
        sum_sigma_1 = fma(s, where(free, by_sigma_1, zero), sum_sigma_1)
        sum_sigma_2 = fma(s, where(free, by_sigma_2, zero), sum_sigma_2)
        sum_turn = sum_turn + fnma(sv, u, su * v)
        if absolute is not None:
            sum_abs_x = sum_abs_x + magnitude(fnma(sine, sv, cosine * su))
            sum_abs_y = sum_abs_y + magnitude(fma(cosine, sv, sine * su))
    # Keep the order of the fields in the layout.
    eight = sums(
        halves_added(sum_1),
        halves_added(sum_u),
        halves_added(sum_v),
        halves_added(sum_sigma_1),
        halves_added(sum_sigma_2),
        halves_added(sum_turn),
        halves_added(sum_red),
        halves_added(sum_green),
    )
    store(partials, partial, eight)
    partials[partial + SUM_BLUE] = total(halves_added(sum_blue))
    if v_depth is not None:
        partials[partial + SUM_DEPTH] = total(halves_added(sum_depth))
    if absolute is not None:
        partials[partial + SUM_ABS_X] = total(halves_added(sum_abs_x))
        partials[partial + SUM_ABS_Y] = total(halves_added(sum_abs_y))


@device
def _backward(
    tile: int,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    masks: NDArray[np.uint64],
    records: NDArray[np.float32],
    constants: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
    absolute: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
    partials: NDArray[np.float32],
    written: NDArray[np.uint8],
) -> None:
    """Sum the gradients of all entries of a tile."""
    columns = (image.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    top = (tile // columns) * TILE_HEIGHT
    left = (tile % columns) * TILE_WIDTH
    state = aligned(DEPTHS + PATCHES * WIDE)
    rows = aligned(BATCH * ROWS)
    responses = aligned(PATCHES * _RESPONSE)
    batch = np.empty(BATCH, np.int64)
    start_tile(state, top, left, image, alpha, depth, v_image, v_alpha, v_depth)
    entry, stop = starts[tile], starts[tile + 1]
    while entry < stop:
        filled = 0
        while filled < BATCH and entry < stop:
            prefetch(records, np.intp(entries[min(entry + 2 * BATCH, stop - 1), 0]) * RECORD)
            prefetch_write(partials, np.intp(entries[entry, 1]) * PARTIAL)
            batch[filled] = entry
            # Write every entry, because a test would be a branch. If an entry has an empty mask,
            # the next entry overwrites it.
            filled += np.intp(masks[entry] != 0)
            entry += 1
        for k in range(filled):
            record, base = np.intp(entries[batch[k], 0]) * RECORD, k * ROWS
            if analytic is None:
                fill_rows(records, record, np.float32(left), np.float32(top), rows, base)
            else:
                fill_axis_rows(records, record, np.float32(left), np.float32(top), rows, base)
        for k in range(filled):
            at = batch[k]
            slot = np.intp(entries[at, 1])
            written[slot] = 1
            record = np.intp(entries[at, 0]) * RECORD
            patches = np.uint64(masks[at])
            base, partial = k * ROWS, slot * PARTIAL
            if analytic is not None:
                _gather_analytic(
                    patches, records, record, rows, base, state, constants, v_depth, absolute,
                    partials, partial,
                )  # fmt: skip
            # There are two variants, because most Gaussians never reach the cap and need less work.
            elif records[record + LOG_OPACITY] <= constants[CAPPED]:
                _gather(
                    patches, records, record, rows, base, state, constants, v_depth, absolute,
                    None, responses, partials, partial,
                )  # fmt: skip
            else:
                _gather(
                    patches, records, record, rows, base, state, constants, v_depth, absolute,
                    constants, responses, partials, partial,
                )  # fmt: skip


@kernel
def differentiate(
    jobs: Jobs,
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
    masks: NDArray[np.uint64],
    records: NDArray[np.float32],
    constants: NDArray[np.float32],
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
    absolute: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
    partials: NDArray[np.float32],
    written: NDArray[np.uint8],
) -> None:
    """Sum the gradients of every entry with a mask over the pixels of its tile.

    Args:
        jobs: Work queue from `share`.
        starts: [T + 1] index of the first entry of each tile.
        entries: [E, 2] record and slot of each entry, from front to back within a tile.
        masks: [E] patches of each entry as bits, from the forward pass.
        records: The records of the drawn Gaussians, flat.
        constants: Constants from `vector_constants`.
        image: [H, W, 3] rendered image with background.
        alpha: [H, W] rendered accumulated opacity.
        depth: [H, W] rendered depth, or None.
        v_image: [H, W, 3] gradient of the loss with respect to the image.
        v_alpha: [H, W] gradient with respect to alpha, or None.
        v_depth: [H, W] gradient with respect to the depth, or None.
        absolute: An array with any content selects the sums of absolute gradients; None omits them.
        analytic: An array with any content selects records of the analytic response; None selects
            the plain response.
        partials: [slots * PARTIAL] output: sums for the slots of entries with a mask.
        written: [slots] output: 1 for the slots of entries with a mask; must be zero at the start.
    """
    tiles = starts.shape[0] - 1
    tile = next_job(jobs, tiles)
    while tile < tiles:
        _backward(
            tile,
            starts,
            entries,
            masks,
            records,
            constants,
            image,
            alpha,
            depth,
            v_image,
            v_alpha,
            v_depth,
            absolute,
            analytic,
            partials,
            written,
        )
        tile = next_job(jobs, tiles)
