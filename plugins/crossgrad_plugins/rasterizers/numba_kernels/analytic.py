"""The analytic response: a Gaussian integrated over the pixel, turned onto its main axes.

Analytic-Splatting approximates the normal distribution by F(x) = sigmoid(1.6 x + 0.07 x^3). A pixel
at offset (u, v) along the main axes of standard deviations sigma1 and sigma2 gets the share
2 pi sigma1 sigma2 W(u, sigma1) W(v, sigma2) of the opacity, where the window of one pixel is

    W(u, sigma) = F((|u| + 1/2) / sigma) - F((|u| - 1/2) / sigma).

With x = -|u| / sigma, h = 1 / (2 sigma), c the cubic, and D = c(x + h) - c(x - h) in closed form,
W = sigmoid(c(x + h)) sigmoid(-c(x - h)) (1 - exp(-D)): products only, so neither tails nor wide
Gaussians cancel. The derivatives below keep to the same terms.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.simd import (
    LANES,
    Lanes,
    bits,
    broadcast,
    fma,
    fnma,
    larger,
    magnitude,
    ramp,
    round_down,
    round_up,
    smaller,
    splat,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.constants import exp2
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COLUMNS,
    COSINE,
    LOG2_E,
    OPACITY,
    REACH_1,
    REACH_2,
    SEGMENT,
    SIGMA_1,
    SIGMA_2,
    SINE,
    TILE_HEIGHT,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
)

LINEAR, CUBIC = 1.6, 0.07
#: Smallest standard deviation along a main axis, px.
SIGMA_FLOOR = 1e-3
_ROOT_2_PI = math.sqrt(2.0 * math.pi)

#: Row buffer: offset along both axes of the row's first pixel centre.
ROW_U = 0
ROW_V = TILE_HEIGHT


@device
def main_axes(a: float, b: float, c: float, det: float) -> tuple[float, float, float, float]:
    """Returns cosine and sine of the longer axis and both variances, px^2.

    A round Gaussian has no main axes: it gets those of the image. The angle is in (-90, 90]
    degrees; it is halved without trigonometric functions, so that loops over it are vectorised.

    Args:
        a: Entry of the undilated covariance [[a, b], [b, c]], px^2.
        b: See `a`.
        c: See `a`.
        det: Its determinant.
    """
    half = 0.5 * (a - c)
    spread = math.sqrt(half * half + b * b)
    double_cosine = half / spread if spread > 0.0 else 1.0
    double_sine = b / spread if spread > 0.0 else 0.0
    # Of cosine and sine, the one that is not small by its own square root.
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
def _sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-max(x, -700.0)))


@device
def window(offset: float, sigma: float) -> float:
    """Returns sqrt(2 pi) sigma W(offset, sigma), in double precision."""
    x, h = -abs(offset) / sigma, 0.5 / sigma
    difference = 2.0 * h * (LINEAR + CUBIC * (3.0 * x * x + h * h))
    share = _sigmoid(_cubic(x + h)) * _sigmoid(-_cubic(x - h)) * -math.expm1(-difference)
    return _ROOT_2_PI * sigma * share


@device
def window_reach(sigma: float, log_contrast: float) -> float:
    """Returns an offset beyond which the window W is below exp(-log_contrast).

    Beyond half a pixel W < sigmoid(-y) < exp(-y) with y the cubic of t = (offset - 1/2) / sigma;
    y(t) = log_contrast has one real root.
    """
    p = LINEAR / (3.0 * CUBIC)
    t = (
        2.0
        * math.sqrt(p)
        * math.sinh(math.asinh(max(log_contrast, 0.0) / (2.0 * CUBIC * p * math.sqrt(p))) / 3.0)
    )
    return 0.5 + sigma * t


@device
def fill_axis_rows(
    records: NDArray[np.float32],
    record: int,
    left: np.float32,
    top: np.float32,
    rows: NDArray[np.float32],
    base: int,
) -> np.uint64:
    """As `footprint.fill_rows`: the segments within reach along both main axes."""
    half = splat(np.float32(0.5))
    dx = splat(left) - broadcast(records, record + U_WHOLE)
    dx = dx + (half - broadcast(records, record + U_PART))
    first_dy = splat(top) - broadcast(records, record + V_WHOLE)
    first_dy = first_dy + (half - broadcast(records, record + V_PART))
    cosine, sine = broadcast(records, record + COSINE), broadcast(records, record + SINE)
    reach_1, reach_2 = broadcast(records, record + REACH_1), broadcast(records, record + REACH_2)
    reached = np.uint64(0)
    for block in range(0, TILE_HEIGHT, LANES):
        dy = first_dy + (ramp() + splat(np.float32(block)))
        u = fma(sine, dy, cosine * dx)
        v = fnma(sine, dx, cosine * dy)
        store(rows, base + ROW_U + block, u)
        store(rows, base + ROW_V + block, v)
        # Pixel x is at u + cosine x and v - sine x. Dividing by zero gives infinite bounds.
        zero = splat(np.float32(0.0))
        low_1, high_1 = (zero - reach_1 - u) / cosine, (reach_1 - u) / cosine
        low_2, high_2 = (v - reach_2) / sine, (v + reach_2) / sine
        first = round_up(larger(smaller(low_1, high_1), smaller(low_2, high_2)))
        last = round_down(smaller(larger(low_1, high_1), larger(low_2, high_2)))
        row_reached = first <= last
        for column in range(COLUMNS):
            begin = splat(np.float32(column * SEGMENT))
            end = splat(np.float32(column * SEGMENT + SEGMENT - 1))
            inside = row_reached & (first <= end) & (last >= begin)
            reached |= bits(inside) << np.uint64(column * TILE_HEIGHT + block)
    return reached


@device
def _number(value: float) -> Lanes:
    return splat(np.float32(value))


@device
def _exp(power: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Returns exp(power) for |power| < 69, and exp(+-69) beyond."""
    limited = larger(smaller(power * _number(LOG2_E), _number(100.0)), _number(-100.0))
    return exp2(limited, constants)


@device
def _one_minus_exp(power: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Returns 1 - exp(-power) for power >= 0, right to a few roundings also where it is small."""
    series = _number(-1.0 / 40320.0)
    series = fma(series, power, _number(1.0 / 5040.0))
    series = fma(series, power, _number(-1.0 / 720.0))
    series = fma(series, power, _number(1.0 / 120.0))
    series = fma(series, power, _number(-1.0 / 24.0))
    series = fma(series, power, _number(1.0 / 6.0))
    series = fma(series, power, _number(-0.5))
    series = fma(series, power, _number(1.0))
    beyond = _number(1.0) - _exp(_number(0.0) - power, constants)
    return where(power <= _number(0.5), series * power, beyond)


@device
def _cubics(x: Lanes) -> Lanes:
    return x * fma(_number(CUBIC), x * x, _number(LINEAR))


@device
def _slopes(x: Lanes) -> Lanes:
    return fma(_number(3.0 * CUBIC), x * x, _number(LINEAR))


@device
def windows(
    offset: Lanes, sigma: Lanes, inverse_sigma: Lanes, constants: NDArray[np.float32]
) -> Lanes:
    """Returns sqrt(2 pi) sigma W(offset, sigma)."""
    x = _number(0.0) - magnitude(offset) * inverse_sigma
    h = _number(0.5) * inverse_sigma
    one = _number(1.0)
    upper = _exp(_number(0.0) - _cubics(x + h), constants)
    lower = _exp(_cubics(x - h), constants)
    difference = (h + h) * fma(_number(CUBIC), fma(_number(3.0), x * x, h * h), _number(LINEAR))
    share = _one_minus_exp(difference, constants) / ((one + upper) * (one + lower))
    return _number(_ROOT_2_PI) * sigma * share


@device
def log_window_gradients(
    offset: Lanes, inverse_sigma: Lanes, constants: NDArray[np.float32]
) -> tuple[Lanes, Lanes]:
    """Returns sigma times the derivatives of log(sigma W) by the offset and by sigma."""
    zero, one = _number(0.0), _number(1.0)
    x = zero - magnitude(offset) * inverse_sigma
    h = _number(0.5) * inverse_sigma
    a, b = x - h, x + h
    upper = _exp(zero - _cubics(b), constants)
    lower = _exp(_cubics(a), constants)
    spread = fma(_number(3.0), x * x, h * h)
    difference = (h + h) * fma(_number(CUBIC), spread, _number(LINEAR))
    share = _one_minus_exp(difference, constants)
    # g = 1 / (exp(D) - 1); above, 1 - F(x + h); below, F(x - h): of which d(log W) consists.
    g = (one - share) / share
    above, below = _slopes(b) * (upper / (one + upper)), _slopes(a) * (lower / (one + lower))
    by_x = fma(g, _number(12.0 * CUBIC) * x * h, above - below)
    by_offset = where(offset < zero, by_x, zero - by_x)
    by_sigma = one - g * fma(_number(4.0 * CUBIC) * h, spread, difference)
    by_sigma = by_sigma - (b * above - a * below)
    return by_offset, by_sigma


@device
def axis_offsets(
    records: NDArray[np.float32],
    record: int,
    offsets: Lanes,
    rows: NDArray[np.float32],
    row: int,
) -> tuple[Lanes, Lanes]:
    """Returns the offsets along the main axes of pixels `offsets` right of the row's first."""
    u = fma(broadcast(records, record + COSINE), offsets, broadcast(rows, row + ROW_U))
    v = fnma(broadcast(records, record + SINE), offsets, broadcast(rows, row + ROW_V))
    return u, v


@device
def coverages(
    records: NDArray[np.float32], record: int, u: Lanes, v: Lanes, constants: NDArray[np.float32]
) -> Lanes:
    """Returns alpha before the cap at offsets (u, v) along the main axes."""
    sigma_1, sigma_2 = broadcast(records, record + SIGMA_1), broadcast(records, record + SIGMA_2)
    first = windows(u, sigma_1, _number(1.0) / sigma_1, constants)
    second = windows(v, sigma_2, _number(1.0) / sigma_2, constants)
    return broadcast(records, record + OPACITY) * first * second
