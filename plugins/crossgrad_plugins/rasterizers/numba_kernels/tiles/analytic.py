"""The analytic response: a Gaussian along its main axes, integrated over each pixel.

Analytic-Splatting approximates the normal distribution by F(x) = sigmoid(1.6 x + 0.07 x^3). Let (u,
v) be the offset of a pixel along the main axes, with standard deviations sigma1 and sigma2. Its
alpha is the opacity times 2 pi sigma1 sigma2 W(u, sigma1) W(v, sigma2). The window W is the
integral of a 1-D normal distribution over one pixel:

    W(u, sigma) = F((|u| + 1/2) / sigma) - F((|u| - 1/2) / sigma).

Let t = |u| / sigma, h = 1 / (2 sigma) and c(x) = 1.6 x + 0.07 x^3. Let D = c(t + h) - c(t - h),
computed in closed form. Then W = (1 - exp(-D)) / ((1 + U) (1 + L)) with U = exp(c(t - h)) and L =
exp(-c(t + h)); also, exp(-D) = U L. For small D, a series replaces 1 - exp(-D), because wide
Gaussians would lose precision by cancellation. The derivatives of W are computed from the same
terms.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD
from crossgrad_core.numerics.simd import (
    Lanes,
    bits,
    broadcast_four_wide,
    broadcast_wide,
    fma,
    fnma,
    larger,
    magnitude,
    ramp_wide,
    round_down,
    round_up,
    smaller,
    splat_wide,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COSINE,
    LOG2_E,
    MIDDLE,
    REACH_1,
    REACH_2,
    SINE,
    SPARE,
    TILE_HEIGHT,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    exp2,
    terms_of,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.footprint import reached_patches

LINEAR, CUBIC = 1.6, 0.07
#: Minimum standard deviation along a main axis, pixels.
SIGMA_FLOOR = 1e-3
#: Maximum standard deviation along a main axis, pixels. A Gaussian of this size is constant over
#: any image, and the product of two such values is still a valid float32 number.
SIGMA_CEILING = 1e18
_ROOT_2_PI = math.sqrt(2.0 * math.pi)
#: Bound of the derivative F': F'(x) <= F'(0) exp(-TAIL x^2 / 2) for all x, with F'(0) = LINEAR / 4.
#: A test checks this bound.
TAIL = 0.9975

# Coefficients of a polynomial for (1 - exp(-D)) / D on [0, 1/2], from low to high power. They
# minimise the maximum relative error (8e-8).
_SERIES = (
    0.999999922724565,
    -0.4999924984754078,
    0.1665481515263426,
    -0.04100127889584338,
    0.006771038068732109,
)

#: Row buffer of a Gaussian: for each pixel row, the offsets along both main axes in the middle
#: column.
ROW_U = 0
ROW_V = TILE_HEIGHT


@device
def main_axes(a: float, b: float, c: float, det: float) -> tuple[float, float, float, float]:
    """Return cosine and sine of the longer axis' angle, and the variances along both axes, px^2.

    For a round Gaussian, which has no main axes, the axes of the image are returned. The angle is
    in (-90, 90] degrees. The angle is halved without trigonometric functions, so that LLVM can
    vectorise loops with this function.

    Args:
        a: Entry of the covariance [[a, b], [b, c]] before dilation, px^2.
        b: Entry of the covariance before dilation, px^2.
        c: Entry of the covariance before dilation, px^2.
        det: Determinant of the covariance.
    """
    half = 0.5 * (a - c)
    spread = math.sqrt(half * half + b * b)
    double_cosine = half / spread if spread > 0.0 else 1.0
    double_sine = b / spread if spread > 0.0 else 0.0
    # Compute the larger of |cosine| and |sine| by a square root, and the smaller one from the
    # larger one.
    main = math.sqrt(0.5 * (1.0 + abs(double_cosine)))
    other = 0.5 * abs(double_sine) / main
    cosine = main if half >= 0.0 else other
    sine = other if half >= 0.0 else main
    larger_variance = 0.5 * (a + c) + spread
    smaller_variance = det / larger_variance
    return cosine, sine if b >= 0.0 else -sine, larger_variance, smaller_variance


@device
def _cubic(x: float) -> float:
    return x * (LINEAR + CUBIC * x * x)


@device
def window(offset: float, sigma: float) -> float:
    """Return sqrt(2 pi) sigma W(offset, sigma), in double precision."""
    t, h = abs(offset) / sigma, 0.5 / sigma
    upper, lower = math.exp(min(_cubic(t - h), 700.0)), math.exp(-_cubic(t + h))
    difference = 2.0 * h * (LINEAR + CUBIC * (3.0 * t * t + h * h))
    share = -math.expm1(-difference) / ((1.0 + upper) * (1.0 + lower))
    return _ROOT_2_PI * sigma * share


@device
def central_window(sigma: float) -> float:
    """Return `window` at offset 0."""
    return _ROOT_2_PI * sigma * math.tanh(0.5 * _cubic(0.5 / sigma))


@device
def squared_radius(opacity: float) -> float:
    """Return a bound R^2: a pixel can be touched only if d1^2 + d2^2 <= R^2.

    d is the distance from the mean to the pixel centre along an axis, minus half a pixel, in
    standard deviations. sigma W is a mean of F' over [t - h, t + h], so sigma W <= F'(0) exp(-TAIL
    d^2 / 2). Therefore alpha is at most the opacity times 2 pi F'(0)^2 exp(-TAIL (d1^2 + d2^2) /
    2).
    """
    contrast = 2.0 * math.pi * (LINEAR / 4.0) ** 2 * opacity / ALPHA_THRESHOLD
    # `SPARE` is larger than the rounding errors of all values that are compared with this bound.
    return 2.0 / TAIL * math.log(max(contrast, 1.0)) + SPARE


@device
def fill_axis_rows(
    records: NDArray[np.float32],
    record: int,
    left: np.float32,
    top: np.float32,
    rows: NDArray[np.float32],
    base: int,
) -> np.uint64:
    """Return the patches that both main axes allow, and write the row buffer."""
    half, zero = _number(0.5), _number(0.0)
    middle = _number(MIDDLE)
    dx = (splat_wide(left) + middle) - broadcast_wide(records, record + U_WHOLE)
    dx = dx + (half - broadcast_wide(records, record + U_PART))
    first_dy = splat_wide(top) - broadcast_wide(records, record + V_WHOLE)
    first_dy = first_dy + (half - broadcast_wide(records, record + V_PART))
    cosine, sine = broadcast_wide(records, record + COSINE), broadcast_wide(records, record + SINE)
    reach_1 = broadcast_wide(records, record + REACH_1)
    reach_2 = broadcast_wide(records, record + REACH_2)
    # Each lane belongs to a pixel row of the tile.
    dy = first_dy + ramp_wide()
    u = fma(sine, dy, cosine * dx)
    v = fnma(sine, dx, cosine * dy)
    store(rows, base + ROW_U, u)
    store(rows, base + ROW_V, v)
    # Along the main axes, the pixel in column x is at u + cosine x and v - sine x. A division by
    # zero gives infinite bounds, which is correct.
    low_1, high_1 = (zero - reach_1 - u) / cosine, (reach_1 - u) / cosine
    low_2, high_2 = (v - reach_2) / sine, (v + reach_2) / sine
    first = round_up(larger(smaller(low_1, high_1), smaller(low_2, high_2)))
    last = round_down(smaller(larger(low_1, high_1), larger(low_2, high_2)))
    return reached_patches(first + middle, last + middle)


@device
def _number(value: float) -> Lanes:
    return splat_wide(np.float32(value))


@device
def _power(x: Lanes) -> Lanes:
    """Return the cubic c(x) in units of log 2."""
    return x * fma(_number(CUBIC * LOG2_E), x * x, _number(LINEAR * LOG2_E))


@device
def _share(difference: Lanes, both: Lanes) -> Lanes:
    """Return 1 - exp(-D) from D >= 0 and exp(-D), also precise for small D."""
    series = _number(_SERIES[4])
    series = fma(series, difference, _number(_SERIES[3]))
    series = fma(series, difference, _number(_SERIES[2]))
    series = fma(series, difference, _number(_SERIES[1]))
    series = fma(series, difference, _number(_SERIES[0]))
    return where(difference <= _number(0.5), series * difference, _number(1.0) - both)


@device
def _window_terms(
    offset: Lanes, inverse_sigma: Lanes, constants: NDArray[np.float32]
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Return U, L, 1 - exp(-D) and (1 + U) (1 + L).

    Powers are limited to 2**-100 .. 2**100.
    """
    zero, one = _number(0.0), _number(1.0)
    t, h = magnitude(offset) * inverse_sigma, _number(0.5) * inverse_sigma
    least, most = _number(-100.0), _number(100.0)
    terms = terms_of(constants)
    upper = exp2(larger(smaller(_power(t - h), most), least), terms)
    lower = exp2(larger(zero - _power(t + h), least), terms)
    spread = fma(_number(3.0), t * t, h * h)
    difference = inverse_sigma * fma(_number(CUBIC), spread, _number(LINEAR))
    share = _share(difference, upper * lower)
    return upper, lower, share, (one + upper) * (one + lower)


@device
def near_enough(
    u: Lanes, v: Lanes, inverse_1: Lanes, inverse_2: Lanes, squared: Lanes
) -> np.uint64:
    """Return as bits the pixels that may be touched (see `squared_radius`)."""
    zero, half = _number(0.0), _number(0.5)
    first = larger(magnitude(u) - half, zero) * inverse_1
    second = larger(magnitude(v) - half, zero) * inverse_2
    return bits(fma(second, second, first * first) <= squared)


@device
def coverages(
    peak: Lanes,
    u: Lanes,
    v: Lanes,
    inverse_1: Lanes,
    inverse_2: Lanes,
    constants: NDArray[np.float32],
) -> Lanes:
    """Return alpha before the cap, at offsets (u, v) along the main axes.

    Args:
        peak: The opacity times 2 pi sigma1 sigma2.
        u: Offset along the first main axis, pixels.
        v: Offset along the second main axis, pixels.
        inverse_1: Inverse standard deviation 1 / sigma1.
        inverse_2: Inverse standard deviation 1 / sigma2.
        constants: Constants from `vector_constants`.
    """
    first = _window_terms(u, inverse_1, constants)
    second = _window_terms(v, inverse_2, constants)
    return peak * (first[2] * second[2]) * (_number(1.0) / (first[3] * second[3]))


@device
def _log_window_gradients(
    offset: Lanes,
    inverse_sigma: Lanes,
    upper: Lanes,
    lower: Lanes,
    share: Lanes,
    inverse_both: Lanes,
) -> tuple[Lanes, Lanes]:
    """Return the derivatives of log(sigma W) with respect to the offset and to sigma, times sigma.

    `inverse_both` is 1 / ((1 + U) (1 + L)); the other arguments are described at `_window_terms`.
    """
    zero, one = _number(0.0), _number(1.0)
    t, h = magnitude(offset) * inverse_sigma, _number(0.5) * inverse_sigma
    p, q = t - h, t + h
    spread = fma(_number(3.0), t * t, h * h)
    difference = inverse_sigma * fma(_number(CUBIC), spread, _number(LINEAR))
    slope, linear = _number(3.0 * CUBIC), _number(LINEAR)
    # Terms of d(log W): g = 1 / (exp(D) - 1); `above` contains 1 - F, and `below` contains F.
    g = (one - share) / share
    above = fma(slope, p * p, linear) * (upper * (one + lower)) * inverse_both
    below = fma(slope, q * q, linear) * (lower * (one + upper)) * inverse_both
    by_t = fma(g, _number(12.0 * CUBIC) * t * h, below - above)
    by_sigma = one - g * fma(_number(4.0 * CUBIC) * h, spread, difference)
    by_sigma = by_sigma + (p * above - q * below)
    return where(offset < zero, zero - by_t, by_t), by_sigma


@device
def coverage_gradients(
    peak: Lanes,
    u: Lanes,
    v: Lanes,
    inverse_1: Lanes,
    inverse_2: Lanes,
    constants: NDArray[np.float32],
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    """Return alpha as `coverages` does, and the derivatives of its logarithm.

    The derivatives are with respect to u, v, sigma1 and sigma2, each multiplied by the standard
    deviation of its axis. For extremely small alpha, the derivatives are undefined.
    """
    upper_1, lower_1, share_1, both_1 = _window_terms(u, inverse_1, constants)
    upper_2, lower_2, share_2, both_2 = _window_terms(v, inverse_2, constants)
    inverse = _number(1.0) / (both_1 * both_2)
    alpha = peak * (share_1 * share_2) * inverse
    by_u, by_sigma_1 = _log_window_gradients(
        u, inverse_1, upper_1, lower_1, share_1, both_2 * inverse
    )
    by_v, by_sigma_2 = _log_window_gradients(
        v, inverse_2, upper_2, lower_2, share_2, both_1 * inverse
    )
    return alpha, by_u, by_v, by_sigma_1, by_sigma_2


@device
def axis_offsets(
    cosine: Lanes, sine: Lanes, offsets: Lanes, rows: NDArray[np.float32], row: int
) -> tuple[Lanes, Lanes]:
    """Return offsets along the main axes for four rows; `offsets` are columns from the middle."""
    u = fma(cosine, offsets, broadcast_four_wide(rows, row + ROW_U))
    v = fnma(sine, offsets, broadcast_four_wide(rows, row + ROW_V))
    return u, v
