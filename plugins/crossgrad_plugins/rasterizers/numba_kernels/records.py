"""Records of the Gaussians that touch a pixel, from projected Gaussians."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD
from crossgrad_plugins.rasterizers.numba_kernels.blocks import get, get_four, put
from crossgrad_plugins.rasterizers.numba_kernels.ewa import clamped
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COSINE,
    DECAY,
    INVERSE_1,
    INVERSE_2,
    LOG2_E,
    LOG_OPACITY,
    PEAK,
    RADIUS,
    REACH_1,
    REACH_2,
    RECORD,
    ROW_DECAY,
    SINE,
    SLOPE,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCH,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    WIDTH,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import (
    SIGMA_CEILING,
    SIGMA_FLOOR,
    central_window,
    main_axes,
    squared_radius,
    window,
)

#: Rows of a block of projected Gaussians, visible or not. The rows are camera depth, projected mean
#: (pixels), dilated 2-D covariance (px^2), its determinant (negative if the Gaussian cannot be
#: drawn), and the factor of the opacity.
CAMERA_DEPTH, MEAN_U, MEAN_V, VARIANCE_X, COVARIANCE, VARIANCE_Y, DETERMINANT, FACTOR = range(8)
#: Rows of the plain response. The rows are 1 / variance in y, slope of the line through the centres
#: of the pixel rows, variance and decay along a pixel row, log2 of the opacity, and both
#: half-extents of the footprint (pixels).
_INVERSE_C, _SLOPE, _VARIANCE, _DECAY, _LOG_OPACITY, _EXTENT_X, _EXTENT_Y = range(8, 15)
FOUND = 15

#: Values of the published footprint: number of standard deviations, lower bound of the squared half
#: difference of the variances (px^4), and side of a tile (pixels).
SIGMAS, LEAST_SPREAD, SQUARE = 3.0, 0.1, 16.0
#: First and last pixel column, and first and last pixel row.
Rectangle = tuple[float, float, float, float]
#: Numbers of a record except mean and colour, in the order of the layout. For the plain response,
#: the numbers are SLOPE to LOG_OPACITY. For the analytic response, the numbers are COSINE to
#: INVERSE_2, REACH_1 to RADIUS, and PEAK.
Plain = tuple[float, float, float, float, float]
Analytic = tuple[float, float, float, float, float, float, float, float]

_LARGEST_RADIUS = 2.0**30
# Gaussians with larger projected values are not drawn. This limit is far below the largest float32
# number.
_LARGEST = 1e30
_STEEPEST = 1e15
# Smallest decay in a record (px^-2). A Gaussian with this decay is constant over any image, and the
# inverse of the decay is still a valid float32 number.
_FLAT = 1e-30

# The format of a float64: number of mantissa bits, exponent of 1, and the bits of 1.0.
_MANTISSA_BITS, _BIAS = 52, 1023
_MANTISSA, _ONE = np.int64((1 << _MANTISSA_BITS) - 1), np.int64(_BIAS << _MANTISSA_BITS)
_ROOT_OF_TWO = math.sqrt(2.0)


@device
def first_pixel(low: float) -> float:
    """Return the first pixel, counted from 0, whose centre is at or after `low`."""
    return max(np.ceil(low - 0.5), 0.0)


@device
def last_pixel(high: float, size: int) -> float:
    """Return the last of `size` pixels whose centre is at or before `high`."""
    return min(np.floor(high - 0.5), size - 1.0)


@device
def _row_hits(
    y: float,
    u: float,
    v: float,
    inverse_c: float,
    slope: float,
    variance: float,
    reach: float,
    width: int,
) -> bool:
    """Return True if the footprint covers a pixel centre in image row `y`."""
    dy = y + 0.5 - v
    left_over = (reach - dy * dy * inverse_c) * variance
    if not left_over >= 0.0:
        return False
    extent = math.sqrt(left_over)
    centre = u + slope * dy
    return first_pixel(centre - extent) <= last_pixel(centre + extent, width)


@device
def _hits(
    y0: float,
    y1: float,
    u: float,
    v: float,
    inverse_c: float,
    slope: float,
    variance: float,
    reach: float,
    width: int,
) -> bool:
    """Return True if the footprint covers any pixel centre in the image rows y0 to y1."""
    middle = clamped(np.floor(v), y0, y1)
    if _row_hits(middle, u, v, inverse_c, slope, variance, reach, width):
        return True
    y = y0
    while y <= y1:
        if _row_hits(y, u, v, inverse_c, slope, variance, reach, width):
            return True
        y += 1.0
    return False


@device
def _pixels(
    u: float,
    v: float,
    extent_x: float,
    extent_y: float,
    width: int,
    height: int,
    within: Rectangle,
) -> Rectangle:
    """Return the pixels that a footprint may touch; x0 > x1 or y0 > y1 means none."""
    return (
        max(first_pixel(u - extent_x), within[0]),
        min(last_pixel(u + extent_x, width), within[1]),
        max(first_pixel(v - extent_y), within[2]),
        min(last_pixel(v + extent_y, height), within[3]),
    )


@device
def place_record(
    j: int,
    u: float,
    v: float,
    pixels: Rectangle,
    records: NDArray[np.float32],
    boxes: NDArray[np.int32],
) -> None:
    """Write the mean and the box of tiles of record j."""
    at = j * RECORD
    records[at + U_WHOLE] = np.floor(u)
    records[at + U_PART] = u - np.float64(records[at + U_WHOLE])
    records[at + V_WHOLE] = np.floor(v)
    records[at + V_PART] = v - np.float64(records[at + V_WHOLE])
    boxes[j, 0] = np.int32(pixels[0]) // TILE_WIDTH
    boxes[j, 1] = np.int32(pixels[1]) // TILE_WIDTH + 1
    boxes[j, 2] = np.int32(pixels[2]) // TILE_HEIGHT
    boxes[j, 3] = np.int32(pixels[3]) // TILE_HEIGHT + 1


@device
def square(k: int, width: int, height: int, found: NDArray[np.float64]) -> tuple[int, Rectangle]:
    """Return the published radius of projected Gaussian k, and the pixels that it may touch.

    The pixels are those in all 16 x 16 tiles that overlap a square around the mean. Half the side
    length of the square is the published radius. The radius is three standard deviations, rounded
    up, as in 3DGS; it is 0 if the square is outside the image. In the formula for the radius, the
    squared half difference of the variances is at least 0.1.
    """
    u, v = get(found, MEAN_U, k), get(found, MEAN_V, k)
    a, b, c = get(found, VARIANCE_X, k), get(found, COVARIANCE, k), get(found, VARIANCE_Y, k)
    nothing = 0, (1.0, 0.0, 1.0, 0.0)
    half = 0.5 * (a - c)
    largest = 0.5 * (a + c) + math.sqrt(max(LEAST_SPREAD, half * half + b * b))
    # If the sum is infinite or NaN, the comparison is false.
    if not (get(found, DETERMINANT, k) > 0.0 and abs(u) + abs(v) + largest < _LARGEST):
        return nothing
    radius = np.ceil(SIGMAS * math.sqrt(largest))
    x0, x1 = first_tile(u - radius), last_tile(u + radius)
    y0, y1 = first_tile(v - radius), last_tile(v + radius)
    if x0 > x1 or y0 > y1 or x0 * SQUARE >= width or y0 * SQUARE >= height:
        return nothing
    pixels = (
        x0 * SQUARE,
        min(x1 * SQUARE + SQUARE, np.float64(width)) - 1.0,
        y0 * SQUARE,
        min(y1 * SQUARE + SQUARE, np.float64(height)) - 1.0,
    )
    return np.int32(min(radius, _LARGEST_RADIUS)), pixels


@device
def first_tile(low: float) -> float:
    """Return the first tile of the published grid at or after position `low`, pixels."""
    return max(np.floor((low - 0.5) / SQUARE), 0.0)


@device
def last_tile(high: float) -> float:
    """Return the last tile of the published grid at or before position `high`; -1 for none."""
    return max(np.floor((high - 0.5) / SQUARE), -1.0)


@device
def _radius(extent: float) -> int:
    """Return the reported radius of a footprint whose half-extent is `extent`."""
    return np.int32(max(1.0, np.ceil(min(extent, _LARGEST_RADIUS))))


@device
def log2_of(value: float) -> float:
    """Return log2 of a normal positive number, with an error below 1e-13.

    For 0, negative numbers and subnormal numbers, the result is at most -1000. For NaN and
    infinity, the result is undefined, so callers must check their arguments. LLVM can vectorise
    loops that call this function, but not loops that call the C library's logarithm.
    """
    raw = np.float64(value).view(np.int64)
    exponent = (raw >> _MANTISSA_BITS) - _BIAS
    mantissa = np.int64((raw & _MANTISSA) | _ONE).view(np.float64)
    large = mantissa > _ROOT_OF_TWO
    mantissa = 0.5 * mantissa if large else mantissa
    # log((1 + s) / (1 - s)) = 2 (s + s^3 / 3 + s^5 / 5 + ...), |s| <= 0.172
    s = (mantissa - 1.0) / (mantissa + 1.0)
    q = s * s
    high = (1.0 / 17.0 * q + 1.0 / 15.0) * q + 1.0 / 13.0
    middle = (1.0 / 11.0 * q + 1.0 / 9.0) * q + 1.0 / 7.0
    low = (0.2 * q + 1.0 / 3.0) * q + 1.0
    series = (high * (q * q * q) + middle) * (q * q * q) + low
    return np.float64(exponent + large) + 2.0 * LOG2_E * s * series


@device
def shape_block(count: int, opacities: NDArray[np.float32], found: NDArray[np.float64]) -> None:
    """Compute the plain response of `count` projected Gaussians, visible or not."""
    for k in range(count):
        a, c, det = get(found, VARIANCE_X, k), get(found, VARIANCE_Y, k), get(found, DETERMINANT, k)
        inverse_c = 1.0 / c
        variance = det * inverse_c
        log_opacity = log2_of(np.float64(opacities[k]) * get(found, FACTOR, k))
        reach = _reach(log_opacity)
        put(found, _INVERSE_C, k, inverse_c)
        put(found, _SLOPE, k, get(found, COVARIANCE, k) * inverse_c)
        put(found, _VARIANCE, k, variance)
        put(found, _DECAY, k, 0.5 * LOG2_E / variance)
        put(found, _LOG_OPACITY, k, log_opacity)
        put(found, _EXTENT_X, k, math.sqrt(reach * a))
        put(found, _EXTENT_Y, k, math.sqrt(reach * c))


@device
def _reach(log_opacity: float) -> float:
    """Return the largest squared distance, in standard deviations, of a touched pixel."""
    return 2.0 / LOG2_E * (log_opacity - TOUCH)


@device
def plain_shape(
    k: int, width: int, height: int, within: Rectangle, found: NDArray[np.float64]
) -> tuple[int, Rectangle, Plain]:
    """Return the radius of projected Gaussian k, its pixels, and the numbers of its record.

    The radius is 0 if the Gaussian touches no pixel. The function writes no array. With several
    return statements, Numba would count references to arrays, which takes time.
    """
    nothing = 0, (1.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)
    u, v = get(found, MEAN_U, k), get(found, MEAN_V, k)
    a, c, det = get(found, VARIANCE_X, k), get(found, VARIANCE_Y, k), get(found, DETERMINANT, k)
    inverse_c, slope, variance, decay = get_four(found, _INVERSE_C, k)
    log_opacity = get(found, _LOG_OPACITY, k)
    reach = _reach(log_opacity)
    # If a term is NaN or infinite, the sum is NaN or infinite, and the comparison is false.
    if not (
        det > 0.0
        and reach >= 0.0
        and a + c + det < math.inf
        and abs(u) + abs(v) + decay + inverse_c < _LARGEST
        and abs(slope) < _STEEPEST
    ):
        return nothing
    extent_x, extent_y = get(found, _EXTENT_X, k), get(found, _EXTENT_Y, k)
    pixels = _pixels(u, v, extent_x, extent_y, width, height, within)
    x0, x1, y0, y1 = pixels
    if x0 > x1 or y0 > y1 or not _hits(y0, y1, u, v, inverse_c, slope, variance, reach, width):
        return nothing
    numbers = (
        slope,
        max(0.5 * LOG2_E * inverse_c, _FLAT),
        max(decay, _FLAT),
        min(2.0 / LOG2_E * variance, 1.0 / _FLAT),
        log_opacity,
    )
    return _radius(max(extent_x, extent_y)), pixels, numbers


@device
def write_plain(j: int, numbers: Plain, records: NDArray[np.float32]) -> None:
    """Write the numbers of record j for the plain response."""
    at = j * RECORD
    records[at + SLOPE] = numbers[0]
    records[at + ROW_DECAY] = numbers[1]
    records[at + DECAY] = numbers[2]
    records[at + WIDTH] = numbers[3]
    records[at + LOG_OPACITY] = numbers[4]


@device
def _covers(
    x: float,
    y: float,
    u: float,
    v: float,
    axis: tuple[float, float],
    sigma: tuple[float, float],
    reach: tuple[float, float],
    opacity: float,
) -> bool:
    """Return True if the analytic response touches pixel (x, y)."""
    dx, dy = x + 0.5 - u, y + 0.5 - v
    along, across = axis[0] * dx + axis[1] * dy, axis[0] * dy - axis[1] * dx
    if abs(along) > reach[0] or abs(across) > reach[1]:
        return False
    return opacity * window(along, sigma[0]) * window(across, sigma[1]) >= ALPHA_THRESHOLD


@device
def analytic_shape(
    k: int,
    opacity: float,
    width: int,
    height: int,
    within: Rectangle,
    found: NDArray[np.float64],
) -> tuple[int, Rectangle, Analytic]:
    """Return the values of `plain_shape` for the analytic response."""
    nothing = 0, (1.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    u, v = get(found, MEAN_U, k), get(found, MEAN_V, k)
    a, c, det = get(found, VARIANCE_X, k), get(found, VARIANCE_Y, k), get(found, DETERMINANT, k)
    if not (det >= 0.0 and a + c + det < math.inf and abs(u) + abs(v) < _LARGEST):
        return nothing
    cosine, sine, variance_1, variance_2 = main_axes(a, get(found, COVARIANCE, k), c, det)
    sigma_1 = clamped(math.sqrt(variance_1), SIGMA_FLOOR, SIGMA_CEILING)
    sigma_2 = clamped(math.sqrt(variance_2), SIGMA_FLOOR, SIGMA_CEILING)
    if not opacity * central_window(sigma_1) * central_window(sigma_2) >= ALPHA_THRESHOLD:
        return nothing
    squared = squared_radius(opacity)
    reach_1 = 0.5 + sigma_1 * math.sqrt(squared)
    reach_2 = 0.5 + sigma_2 * math.sqrt(squared)
    if not reach_1 + reach_2 < _LARGEST:
        return nothing
    extent_x = abs(cosine) * reach_1 + abs(sine) * reach_2
    extent_y = abs(sine) * reach_1 + abs(cosine) * reach_2
    pixels = _pixels(u, v, extent_x, extent_y, width, height, within)
    x0, x1, y0, y1 = pixels
    if x0 > x1 or y0 > y1:
        return nothing
    axis, sigma, reach = (cosine, sine), (sigma_1, sigma_2), (reach_1, reach_2)
    x, y = clamped(np.floor(u), x0, x1), clamped(np.floor(v), y0, y1)
    touched = _covers(x, y, u, v, axis, sigma, reach, opacity)
    y = y0
    while not touched and y <= y1:
        x = x0
        while not touched and x <= x1:
            touched = _covers(x, y, u, v, axis, sigma, reach, opacity)
            x += 1.0
        y += 1.0
    if not touched:
        return nothing
    numbers = (
        cosine,
        sine,
        1.0 / sigma_1,
        1.0 / sigma_2,
        reach_1,
        reach_2,
        squared,
        2.0 * math.pi * opacity * sigma_1 * sigma_2,
    )
    radius = _radius(math.sqrt(2.0 * math.log(opacity / ALPHA_THRESHOLD) * max(a, c)))
    return radius, pixels, numbers


@device
def write_analytic(j: int, numbers: Analytic, records: NDArray[np.float32]) -> None:
    """Write the numbers of record j for the analytic response."""
    at = j * RECORD
    records[at + COSINE], records[at + SINE] = numbers[0], numbers[1]
    records[at + INVERSE_1], records[at + INVERSE_2] = numbers[2], numbers[3]
    records[at + REACH_1], records[at + REACH_2] = numbers[4], numbers[5]
    records[at + RADIUS], records[at + PEAK] = numbers[6], numbers[7]
