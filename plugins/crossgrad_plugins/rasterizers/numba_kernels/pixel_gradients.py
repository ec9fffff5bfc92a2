"""Gradients of single pixels by the projected mean of a Gaussian.

The operations are those of `backward` in its order, hence with its bits; only what the sums of
other gradients need is left out.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    WIDE,
    Lanes,
    broadcast_four_wide,
    broadcast_wide,
    fma,
    fnma,
    load_wide,
    smaller,
    splat_wide,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.analytic import (
    axis_offsets,
    coverage_gradients,
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
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLUE,
    COSINE,
    DECAY,
    DEPTH,
    GREEN,
    INVERSE_1,
    INVERSE_2,
    PEAK,
    RED,
    ROW_DECAY,
    SINE,
    SLOPE,
)
from crossgrad_plugins.rasterizers.numba_kernels.patches import column_of, row_of
from crossgrad_plugins.rasterizers.numba_kernels.pixel_states import (
    DEPTHS,
    STATE,
    V_BLUE,
    V_GREEN,
    V_RED,
    blend,
    odds_of,
)


@device
def _weighted_color(
    patch: int,
    records: NDArray[np.float32],
    record: int,
    state: NDArray[np.float32],
    v_depth: NDArray[np.float32] | None,
) -> Lanes:
    """The gradients of a patch's pixels times the colour of the Gaussian."""
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
    """Blends into a patch; returns its pixels' gradients by the projected mean (x and y).

    The gradients of plain records are in units of 2 log 2 px^-1, the others in px^-1.
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
