"""Gradients of the tiles' pixels, summed per entry (Gaussian and tile), front to back.

With S the part of the loss' linear form still to come behind the Gaussian at hand (its start value
is the gradient of the pixel times the pixel), and c the gradient times the Gaussian's colour,

    dL/d(alpha) = T c - S / (1 - alpha),

so one pass in drawing order suffices, and the transmittance T is the forward pass' own, bit for
bit. The gradient of the accumulated opacity only lowers the start value of S by itself times the
final transmittance; the accumulated depth is one more colour channel.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, take
from crossgrad_core.numerics.simd import (
    LANES,
    broadcast,
    fma,
    fnma,
    load,
    lowest_bit,
    magnitude,
    prefetch,
    prefetch_write,
    smaller,
    splat,
    store,
    sums,
    total,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.analytic import (
    axis_offsets,
    coverage_gradients,
    fill_axis_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.constants import (
    CAPPED,
    FIXED,
    LARGEST_ALPHA,
    LEAST,
    OFFSETS,
    TOUCHED,
    exp2,
    terms_of,
)
from crossgrad_plugins.rasterizers.numba_kernels.footprint import (
    ROW_CENTRE,
    ROW_DY,
    ROW_EXPONENT,
    ROWS,
    fill_rows,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLUE,
    COSINE,
    DECAY,
    DEPTH,
    GREEN,
    INVERSE_1,
    INVERSE_2,
    LOG_OPACITY,
    PAIR,
    PARTIAL,
    PEAK,
    RECORD,
    RED,
    ROW_DECAY,
    SEGMENTS,
    SINE,
    SLOPE,
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_BLUE,
    SUM_DEPTH,
    TILE_HEIGHT,
    TILE_WIDTH,
)
from crossgrad_plugins.rasterizers.numba_kernels.pixel_states import (
    DEPTHS,
    STATE,
    V_BLUE,
    V_GREEN,
    V_RED,
    blend,
    odds_of,
    start_tile,
)
from crossgrad_plugins.rasterizers.numba_kernels.segments import aligned

#: Numbers of the response in a segment: alpha, and its odds.
RESPONSE = 2 * LANES

#: Entries whose row buffers are filled before the first of them is processed.
BATCH = 8


@device
def _respond(
    reached: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    constants: NDArray[np.float32],
    capped: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
) -> None:
    """Writes the plain response in the reached segments, one after the other: alpha, its odds.

    A loop of its own: nothing in it waits for the transmittance, which a segment gets from the
    Gaussian before, so that the processor works on several segments at once.
    """
    decay = broadcast(records, record + DECAY)
    terms = terms_of(constants)
    zero = splat(np.float32(0.0))
    at = 0
    while reached != np.uint64(0):
        segment = lowest_bit(reached)
        reached &= reached - np.uint64(1)
        row = base + (segment & (TILE_HEIGHT - 1))
        offsets = load(constants, OFFSETS + (segment // TILE_HEIGHT) * PAIR)
        dx = offsets - broadcast(rows, row + ROW_CENTRE)
        power = fnma(decay * dx, dx, broadcast(rows, row + ROW_EXPONENT))
        touched = power >= load(constants, TOUCHED)
        alpha = where(touched, smaller(exp2(power, terms), load(constants, LARGEST_ALPHA)), zero)
        odds = odds_of(alpha, constants)
        if capped is not None:
            odds = where(power <= load(constants, CAPPED), odds, load(constants, FIXED))
        store(responses, at, alpha)
        store(responses, at + LANES, odds)
        at += RESPONSE


@device
def _gather(
    reached: np.uint64,
    records: NDArray[np.float32],
    record: int,
    rows: NDArray[np.float32],
    base: int,
    state: NDArray[np.float32],
    constants: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
    absolute: NDArray[np.float32] | None,
    analytic: NDArray[np.float32] | None,
    capped: NDArray[np.float32] | None,
    responses: NDArray[np.float32],
    partials: NDArray[np.float32],
    partial: int,
) -> None:
    """Sums the gradients of one Gaussian over the reached segments into partials[partial:].

    `capped` is None for Gaussians whose alpha reaches the largest one nowhere.
    """
    decay = broadcast(records, record + DECAY)
    red = broadcast(records, record + RED)
    green = broadcast(records, record + GREEN)
    blue = broadcast(records, record + BLUE)
    z = broadcast(records, record + DEPTH)
    # d(exponent)/d(mean y) = log 2 (2 row_decay dy - 2 slope decay dx)
    pull = broadcast(records, record + ROW_DECAY)
    lean = decay * broadcast(records, record + SLOPE)
    cosine, sine = broadcast(records, record + COSINE), broadcast(records, record + SINE)
    inverse_1 = broadcast(records, record + INVERSE_1)
    inverse_2 = broadcast(records, record + INVERSE_2)
    peak = broadcast(records, record + PEAK)
    zero = splat(np.float32(0.0))
    sum_1 = sum_a = sum_b = sum_c = sum_d = sum_e = zero
    sum_red = sum_green = sum_blue = sum_depth = sum_abs_x = sum_abs_y = zero
    if analytic is None:
        _respond(reached, records, record, rows, base, constants, capped, responses)
    response = 0
    while reached != np.uint64(0):
        segment = lowest_bit(reached)
        reached &= reached - np.uint64(1)
        row = base + (segment & (TILE_HEIGHT - 1))
        at = segment * STATE
        offsets = load(constants, OFFSETS + (segment // TILE_HEIGHT) * PAIR)
        if analytic is None:
            dx = offsets - broadcast(rows, row + ROW_CENTRE)
            alpha, odds = load(responses, response), load(responses, response + LANES)
            response += RESPONSE
        else:
            u, v = axis_offsets(cosine, sine, offsets, rows, row)
            alpha, by_u, by_v, by_sigma_1, by_sigma_2 = coverage_gradients(
                peak, u, v, inverse_1, inverse_2, constants
            )
            touched = alpha >= load(constants, LEAST)
            free = touched & (alpha <= load(constants, LARGEST_ALPHA))
            alpha = where(touched, smaller(alpha, load(constants, LARGEST_ALPHA)), zero)
            odds = where(free, odds_of(alpha, constants), load(constants, FIXED))
        v_red = load(state, at + V_RED)
        v_green = load(state, at + V_GREEN)
        v_blue = load(state, at + V_BLUE)
        toned = fma(v_blue, blue, fma(v_green, green, v_red * red))
        if v_depth is not None:
            v_z = load(state, DEPTHS + segment * LANES)
            toned = fma(v_z, z, toned)
        weight, s = blend(alpha, odds, capped, toned, state, at, constants)
        sum_red = fma(weight, v_red, sum_red)
        sum_green = fma(weight, v_green, sum_green)
        sum_blue = fma(weight, v_blue, sum_blue)
        if v_depth is not None:
            sum_depth = fma(weight, v_z, sum_depth)
        sum_1 = sum_1 + s
        if analytic is None:
            dy = broadcast(rows, row + ROW_DY)
            sd = s * dx
            sy = s * dy
            sum_a = sum_a + sd
            sum_b = sum_b + sy
            sum_c = fma(sd, dx, sum_c)
            sum_d = fma(sy, dy, sum_d)
            sum_e = fma(sd, dy, sum_e)
            if absolute is not None:
                sum_abs_x = sum_abs_x + magnitude(sd)
                sum_abs_y = sum_abs_y + magnitude(fnma(lean, sd, pull * sy))
        else:
            su = where(free, s * by_u * inverse_1, zero)
            sv = where(free, s * by_v * inverse_2, zero)
            sum_a = sum_a + su
            sum_b = sum_b + sv
            sum_c = fma(s, where(free, by_sigma_1, zero), sum_c)
            sum_d = fma(s, where(free, by_sigma_2, zero), sum_d)
            sum_e = sum_e + fnma(sv, u, su * v)
            if absolute is not None:
                sum_abs_x = sum_abs_x + magnitude(fnma(sine, sv, cosine * su))
                sum_abs_y = sum_abs_y + magnitude(fma(cosine, sv, sine * su))
    # In the order of SUM_1, SUM_D, SUM_Y, ... or SUM_1, SUM_U, SUM_V, ... of the layout.
    store(partials, partial, sums(sum_1, sum_a, sum_b, sum_c, sum_d, sum_e, sum_red, sum_green))
    partials[partial + SUM_BLUE] = total(sum_blue)
    if v_depth is not None:
        partials[partial + SUM_DEPTH] = total(sum_depth)
    if absolute is not None:
        partials[partial + SUM_ABS_X] = total(sum_abs_x)
        partials[partial + SUM_ABS_Y] = total(sum_abs_y)


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
    """Sums the gradients of one tile's entries."""
    columns = (image.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    top = (tile // columns) * TILE_HEIGHT
    left = (tile % columns) * TILE_WIDTH
    state = aligned(DEPTHS + SEGMENTS * LANES)
    rows = aligned(BATCH * ROWS)
    responses = aligned(SEGMENTS * RESPONSE)
    batch = np.empty(BATCH, np.int64)
    start_tile(state, top, left, image, alpha, depth, v_image, v_alpha, v_depth)
    entry, stop = starts[tile], starts[tile + 1]
    while entry < stop:
        filled = 0
        while filled < BATCH and entry < stop:
            prefetch(records, np.intp(entries[min(entry + BATCH, stop - 1), 0]) * RECORD)
            record = np.intp(entries[entry, 0]) * RECORD
            if analytic is None:
                fill_rows(records, record, np.float32(left), np.float32(top), rows, filled * ROWS)
            else:
                fill_axis_rows(
                    records, record, np.float32(left), np.float32(top), rows, filled * ROWS
                )
            batch[filled] = entry
            prefetch_write(partials, np.intp(entries[entry, 1]) * PARTIAL)
            filled += np.intp(masks[entry] != 0)
            entry += 1
        for k in range(filled):
            at = batch[k]
            slot = np.intp(entries[at, 1])
            written[slot] = 1
            record = np.intp(entries[at, 0]) * RECORD
            # Two loops: that of the many Gaussians that no pixel caps has less to do.
            if analytic is None and records[record + LOG_OPACITY] <= constants[CAPPED]:
                _gather(
                    np.uint64(masks[at]), records, record, rows, k * ROWS, state, constants,
                    v_depth, absolute, analytic, None, responses, partials, slot * PARTIAL,
                )  # fmt: skip
            else:
                _gather(
                    np.uint64(masks[at]), records, record, rows, k * ROWS, state, constants,
                    v_depth, absolute, analytic, constants, responses, partials, slot * PARTIAL,
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
    """Sums the gradients of every entry with a mask over its tile's pixels.

    Args:
        jobs: From `share`.
        starts: [T + 1] first entry of each tile.
        entries: [E, 2] records and slots of each tile, front to back.
        masks: [E] segments per entry, as the forward pass left them.
        records: Records of the drawn Gaussians, flat.
        constants: From `vector_constants`.
        image: [H, W, 3] as drawn, background included.
        alpha: [H, W] as drawn.
        depth: [H, W] as drawn, or None.
        v_image: [H, W, 3] gradient of the loss by the image.
        v_alpha: [H, W] gradient by alpha, or None.
        v_depth: [H, W] gradient by the depth, or None.
        absolute: Any vector asks for the sums of absolute gradients; None leaves them out.
        analytic: As in `composite`.
        partials: [slots * PARTIAL] written for slots of entries with a mask.
        written: [slots] 1 written for these; zero before.
    """
    tile = take(jobs)
    while tile < starts.shape[0] - 1:
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
        tile = take(jobs)
