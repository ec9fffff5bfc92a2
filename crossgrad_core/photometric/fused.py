"""The photometric loss and its gradient in one pass over the image (Numba, CPU, float32).

With s = x + y and d = x - y (x the image, y the target) SSIM needs four windowed means instead of
five, M_s, M_d, E[s^2], E[d^2], and factors without cancellation between the two images:

    SSIM = (M_s^2 - M_d^2 + 2 C1) (V_s - V_d + 2 C2) / ((M_s^2 + M_d^2 + 2 C1) (V_s + V_d + 2 C2)),

with V = E[.^2] - M^2. Its gradient is G * a + s (G * b) + d (G * c), where G * is the same window
and a, b, c hold the derivatives by M_s + M_d, V_s and V_d. Variances are differences of nearly
equal numbers where the image is smooth, so s and d are taken relative to a centre: their means over
the tile (per channel).

The image is cut into tiles whose size depends on the image's size only. A tile runs down its rows
with ring buffers of sixteen rows (s, d, mask; a, b, c), so that the working set stays in the
second-level cache and memory does not grow with the image. Rows are kept interleaved,
[column * 3 + channel]: a step of one column is three floats. Every tile recomputes its halo, so
tiles are independent and the result has the same bits for any number of threads.
"""
# ruff: noqa: ANN401, ARG001 - Numba's extension points are untyped and fix the arguments.

from typing import Any, TypeAlias

import numpy as np
from numba import get_num_threads, prange, types
from numpy.typing import NDArray

from crossgrad_core.jit import kernel, parallel_kernel, sum_kernel
from crossgrad_core.photometric._simd import (
    LANES,
    emitted,
    f32x8,
    load,
    product,
    splat,
    store,
    symmetric_sum,
    vector_at,
    where_positive,
)
from crossgrad_core.photometric.reference import C1, C2, RADIUS, WINDOW, gaussian_window

_Floats: TypeAlias = NDArray[np.float32]  # 1-D
_Bytes: TypeAlias = NDArray[np.uint8]  # 1-D
_Flags: TypeAlias = NDArray[np.bool_]  # 1-D
_Box: TypeAlias = tuple[int, int, int, int]  # first row, end row, first column, end column

_TILE_ROWS = 64
_TILE_COLUMNS = 384
_SLOTS = 16  # rows of a ring; a power of two, at least WINDOW
_CHANNELS = 3
_HALO = _CHANNELS * RADIUS  # floats
# Room for a tile with twice the halo on both sides, and for vectors that start before its end.
_STRIDE = _CHANNELS * _TILE_COLUMNS + 4 * _HALO + _CHANNELS * WINDOW + 3 * LANES
_STRIDE -= _STRIDE % LANES

# Scratch memory of a tile, in floats.
_SUM = 0  # ring of s - centre
_DIFFERENCE = _SUM + _SLOTS * _STRIDE  # ring of d - centre
_KEEP = _DIFFERENCE + _SLOTS * _STRIDE  # ring of 1 where a pixel counts, else 0
_PARTIAL = _KEEP + _SLOTS * _STRIDE  # s, s^2, d, d^2 of one row, summed down the columns
_BY_MEAN = _PARTIAL + 4 * _STRIDE  # rings of a, b, c
_BY_SUM_VARIANCE = _BY_MEAN + _SLOTS * _STRIDE
_BY_DIFFERENCE_VARIANCE = _BY_SUM_VARIANCE + _SLOTS * _STRIDE
_BACK = _BY_DIFFERENCE_VARIANCE + _SLOTS * _STRIDE  # a, b, c of one row, summed down the columns
_LINE = _BACK + 3 * _STRIDE  # a row of results
_CENTRE_SUM = _LINE + _STRIDE  # what is subtracted from s
_CENTRE_DIFFERENCE = _CENTRE_SUM + _STRIDE  # what is subtracted from d
_SCRATCH = _CENTRE_DIFFERENCE + _STRIDE

_WEIGHTS = tuple(float(np.float32(w)) for w in gaussian_window().numpy()[: RADIUS + 1])
_ZERO, _ONE, _TWO, _HALF = (np.float32(v) for v in (0, 1, 2, 0.5))
_TWICE_C1, _TWICE_C2 = np.float32(2 * C1), np.float32(2 * C2)
_WHITE = np.float32(255)


@emitted
def _across(typing_context: Any, array: Any, start: Any) -> Any:
    """Window sum over eleven columns, the first of them at element `start`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type, (row, first) = signature.args[0], args
        starts = [builder.add(first, first.type(_CHANNELS * k)) for k in range(WINDOW)]
        taps = [vector_at(context, builder, array_type, row, index) for index in starts]
        return symmetric_sum(builder, taps, _WEIGHTS)

    return f32x8(array, types.intp), generate


def _ring_taps(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """Column `start` of the ring's rows row - 5 .. row + 5."""
    array, start, row = args
    taps = []
    for k in range(-RADIUS, RADIUS + 1):
        slot = builder.and_(builder.add(row, row.type(k)), row.type(_SLOTS - 1))
        index = builder.add(start, builder.mul(slot, row.type(_STRIDE)))
        taps.append(vector_at(context, builder, signature.args[0], array, index))
    return taps


@emitted
def _down(typing_context: Any, array: Any, start: Any, row: Any) -> Any:
    """Window sum over rows row - 5 .. row + 5 of the ring whose column is at element `start`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        taps = _ring_taps(context, builder, signature, args)
        return symmetric_sum(builder, taps, _WEIGHTS)

    return f32x8(array, types.intp, types.intp), generate


@emitted
def _down_with_squares(typing_context: Any, array: Any, start: Any, row: Any) -> Any:
    """Window sums over rows row - 5 .. row + 5 of the ring's values and of their squares."""
    pair: Any = types.UniTuple(f32x8, 2)  # type: ignore[no-untyped-call]

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        taps = _ring_taps(context, builder, signature, args)
        squares = [product(builder, tap, tap) for tap in taps]
        sums = [symmetric_sum(builder, values, _WEIGHTS) for values in (taps, squares)]
        return context.make_tuple(builder, pair, sums)

    return pair(array, types.intp, types.intp), generate


@kernel
def _set_centres(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, box: _Box, width: int,
) -> None:  # fmt: skip
    """Per channel, means of s and d over every eighth row of the tile, x and y clipped."""
    top, bottom, left, right = box
    for channel in range(_CHANNELS):
        count = 1e-9  # nothing kept: the sums are 0, and so are the centres
        sum_x, sum_y = 0.0, 0.0
        for row in range(top, bottom, 8):
            for column in range(left, right):
                if is_masked and not mask[row * width + column]:
                    continue
                count += 1.0
                i = (row * width + column) * _CHANNELS + channel
                y = np.float32(target_8bit[i]) / _WHITE if is_8bit else target[i]
                # In this order a NaN counts as 0.
                sum_x += float(min(max(_ZERO, image[i]), _ONE))
                sum_y += float(min(max(_ZERO, y), _ONE))
        centre_sum = np.float32((sum_x + sum_y) / count)
        centre_difference = np.float32((sum_x - sum_y) / count)
        for j in range(channel, _STRIDE, _CHANNELS):
            scratch[_CENTRE_SUM + j] = centre_sum
            scratch[_CENTRE_DIFFERENCE + j] = centre_difference


# Loops over views from 0 on, because an index that may be negative keeps LLVM from vectorising.


@kernel
def _fill(array: _Floats, start: int, count: int, value: np.float32) -> None:
    view = array[start : start + count]
    for j in range(count):
        view[j] = value


@kernel
def _copy(destination: _Floats, start: int, source: _Floats, source_start: int, count: int) -> None:
    view, values = destination[start : start + count], source[source_start : source_start + count]
    for j in range(count):
        view[j] = values[j]


@kernel
def _copy_8bit(
    destination: _Floats, start: int, source: _Bytes, source_start: int, count: int
) -> None:
    view, values = destination[start : start + count], source[source_start : source_start + count]
    for j in range(count):
        view[j] = np.float32(values[j]) / _WHITE


@kernel
def _copy_mask(
    destination: _Floats, start: int, mask: _Flags, mask_start: int, pixels: int
) -> None:
    """Each pixel's mask, once per channel, as 0 or 1."""
    view, values = destination[start : start + _CHANNELS * pixels], mask[mask_start:]
    for pixel in range(pixels):
        keep = np.float32(values[pixel])
        view[3 * pixel], view[3 * pixel + 1], view[3 * pixel + 2] = keep, keep, keep


@kernel
def _load_row(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, row: int, box: _Box, height: int, width: int,
) -> None:  # fmt: skip
    """Puts s, d (relative to their centres) and the mask of a row into the rings.

    Outside the image and at masked-out pixels both images are 0.
    """
    first = _CHANNELS * (box[2] - 2 * RADIUS)  # float column of the image at the ring's column 0
    count = _CHANNELS * (box[3] - box[2] + 4 * RADIUS)
    slot = (row & (_SLOTS - 1)) * _STRIDE
    s, d, keep = _SUM + slot, _DIFFERENCE + slot, _KEEP + slot
    begin, end = 0, 0
    if 0 <= row < height:
        begin, end = max(0, -first), min(count, _CHANNELS * width - first)
    # x and y themselves come first, and are turned into s and d in place.
    for ring in (s, d, keep):
        _fill(scratch, ring, begin, _ZERO)
        _fill(scratch, ring + end, count - end, _ZERO)
    source = row * _CHANNELS * width + first + begin
    _copy(scratch, s + begin, image, source, end - begin)
    if is_8bit:
        _copy_8bit(scratch, d + begin, target_8bit, source, end - begin)
    else:
        _copy(scratch, d + begin, target, source, end - begin)
    if is_masked:
        pixels = (end - begin) // _CHANNELS
        _copy_mask(scratch, keep + begin, mask, source // _CHANNELS, pixels)
    else:
        _fill(scratch, keep + begin, end - begin, _ONE)
    zero = splat(_ZERO)
    for j in range(0, count, LANES):
        kept = load(scratch, keep + j)
        x = where_positive(kept, load(scratch, s + j), zero)
        y = where_positive(kept, load(scratch, d + j), zero)
        store(scratch, s + j, x + y - load(scratch, _CENTRE_SUM + j))
        store(scratch, d + j, x - y - load(scratch, _CENTRE_DIFFERENCE + j))


@kernel
def _ssim_row(scratch: _Floats, row: int, columns: int) -> None:
    """Writes 1 - SSIM of a row to the line and a, b, c to their rings, 0 where nothing counts."""
    for j in range(0, _CHANNELS * (columns + 4 * RADIUS), LANES):
        values, squares = _down_with_squares(scratch, _SUM + j, row)
        store(scratch, _PARTIAL + j, values)
        store(scratch, _PARTIAL + _STRIDE + j, squares)
        values, squares = _down_with_squares(scratch, _DIFFERENCE + j, row)
        store(scratch, _PARTIAL + 2 * _STRIDE + j, values)
        store(scratch, _PARTIAL + 3 * _STRIDE + j, squares)
    slot = (row & (_SLOTS - 1)) * _STRIDE
    zero, one, two = splat(_ZERO), splat(_ONE), splat(_TWO)
    twice_c1, twice_c2 = splat(_TWICE_C1), splat(_TWICE_C2)
    for j in range(0, _CHANNELS * (columns + 2 * RADIUS), LANES):
        keep = load(scratch, _KEEP + slot + _HALO + j)
        local_s = _across(scratch, _PARTIAL + j)
        local_d = _across(scratch, _PARTIAL + 2 * _STRIDE + j)
        variance_s = _across(scratch, _PARTIAL + _STRIDE + j) - local_s * local_s
        variance_d = _across(scratch, _PARTIAL + 3 * _STRIDE + j) - local_d * local_d
        # Rounding may take a variance of nothing slightly below zero.
        variance_s = where_positive(variance_s, variance_s, zero) + twice_c2
        variance_d = where_positive(variance_d, variance_d, zero)
        mean_s = local_s + load(scratch, _CENTRE_SUM + j)
        mean_d = local_d + load(scratch, _CENTRE_DIFFERENCE + j)
        bright = mean_s * mean_s + twice_c1
        dark = mean_d * mean_d
        over_mean = one / (bright + dark)
        over_variance = one / (variance_s + variance_d)
        # 1 minus the luminance term and 1 minus the contrast-structure term: exactly 0 where x = y.
        luminance_loss = two * dark * over_mean
        contrast_loss = two * variance_d * over_variance
        dissimilarity = luminance_loss + contrast_loss - luminance_loss * contrast_loss
        store(scratch, _LINE + j, where_positive(keep, dissimilarity, zero))
        by_variance = two * (one - luminance_loss) * over_variance * over_variance
        by_sum = by_variance * variance_d
        by_difference = zero - by_variance * variance_s
        by_mean = two * two * (one - contrast_loss) * over_mean * over_mean
        by_mean = by_mean * (mean_s * dark - mean_d * bright)
        by_mean = by_mean - two * (local_s * by_sum + local_d * by_difference)
        store(scratch, _BY_MEAN + slot + j, where_positive(keep, by_mean, zero))
        store(scratch, _BY_SUM_VARIANCE + slot + j, where_positive(keep, two * by_sum, zero))
        store(
            scratch,
            _BY_DIFFERENCE_VARIANCE + slot + j,
            where_positive(keep, two * by_difference, zero),
        )


@kernel
def _clear_row(scratch: _Floats, row: int, columns: int) -> None:
    """Sets a, b, c of a row outside the image to 0."""
    slot = (row & (_SLOTS - 1)) * _STRIDE
    for ring in (_BY_MEAN, _BY_SUM_VARIANCE, _BY_DIFFERENCE_VARIANCE):
        _fill(scratch, ring + slot, _CHANNELS * (columns + 2 * RADIUS), _ZERO)


@kernel
def _gradient_row(
    scratch: _Floats, row: int, columns: int, l1_weight: np.float32, ssim_weight: np.float32
) -> None:
    """Writes the loss's gradient at a row of the tile to the line."""
    for j in range(0, _CHANNELS * (columns + 2 * RADIUS), LANES):
        store(scratch, _BACK + j, _down(scratch, _BY_MEAN + j, row))
        store(scratch, _BACK + _STRIDE + j, _down(scratch, _BY_SUM_VARIANCE + j, row))
        store(scratch, _BACK + 2 * _STRIDE + j, _down(scratch, _BY_DIFFERENCE_VARIANCE + j, row))
    slot = (row & (_SLOTS - 1)) * _STRIDE + 2 * _HALO
    zero, plus, weight = splat(_ZERO), splat(l1_weight), splat(ssim_weight)
    minus = zero - plus
    for j in range(0, _CHANNELS * columns, LANES):
        s = load(scratch, _SUM + slot + j)
        d = load(scratch, _DIFFERENCE + slot + j)
        difference = d + load(scratch, _CENTRE_DIFFERENCE + j)
        ssim = _across(scratch, _BACK + j)
        ssim = ssim + s * _across(scratch, _BACK + _STRIDE + j)
        ssim = ssim + d * _across(scratch, _BACK + 2 * _STRIDE + j)
        l1 = where_positive(difference, plus, where_positive(zero - difference, minus, zero))
        keep = load(scratch, _KEEP + slot + j)
        store(scratch, _LINE + j, where_positive(keep, l1 - ssim * weight, zero))


@sum_kernel
def _sum(array: _Floats, start: int, count: int) -> float:
    view = array[start : start + count]
    total = 0.0
    for j in range(count):
        total += np.float64(view[j])
    return total


@sum_kernel
def _sum_absolute(scratch: _Floats, start: int, count: int) -> float:
    """Sum of |d| from element `start` of the ring on; the pixel at `start` begins a period."""
    view, centre = scratch[start : start + count], scratch[_CENTRE_DIFFERENCE:]
    total = 0.0
    for j in range(count):
        total += np.float64(abs(view[j] + centre[j]))
    return total


@kernel
def _tile(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, gradient: _Floats, with_gradient: bool,
    box: _Box, height: int, width: int, l1_weight: np.float32, ssim_weight: np.float32,
) -> tuple[float, float]:  # fmt: skip
    """Sums of |x - y| and 1 - SSIM over a tile; its gradient is written to `gradient`."""
    top, bottom, left, right = box
    columns = right - left
    halo = RADIUS if with_gradient else 0
    absolute, dissimilarity = 0.0, 0.0
    _set_centres(scratch, image, target, target_8bit, is_8bit, mask, is_masked, box, width)
    loaded = top - halo - RADIUS
    for row in range(top - halo, bottom + halo):
        while loaded <= row + RADIUS:
            _load_row(
                scratch, image, target, target_8bit, is_8bit, mask, is_masked, loaded, box,
                height, width,
            )  # fmt: skip
            loaded += 1
        if 0 <= row < height:
            _ssim_row(scratch, row, columns)
        else:
            _clear_row(scratch, row, columns)
        if top <= row < bottom:
            dissimilarity += _sum(scratch, _LINE + _HALO, _CHANNELS * columns)
            slot = _DIFFERENCE + (row & (_SLOTS - 1)) * _STRIDE + 2 * _HALO
            absolute += _sum_absolute(scratch, slot, _CHANNELS * columns)
        if with_gradient and row - RADIUS >= top:
            _gradient_row(scratch, row - RADIUS, columns, l1_weight, ssim_weight)
            destination = ((row - RADIUS) * width + left) * _CHANNELS
            _copy(gradient, destination, scratch, _LINE, _CHANNELS * columns)
    return absolute, dissimilarity


@parallel_kernel
def _all_tiles(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, gradient: _Floats, with_gradient: bool,
    height: int, width: int, l1_weight: np.float32, ssim_weight: np.float32,
    sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Runs every tile; tile t uses row t % step of `scratch` [step, _SCRATCH]."""
    step = scratch.shape[0]
    down, across = sums.shape[0], sums.shape[1]
    rows, columns = (height + down - 1) // down, (width + across - 1) // across
    for first in prange(step):
        for t in range(np.int64(first), down * across, step):
            top, left = t // across * rows, t % across * columns
            box = (top, min(height, top + rows), left, min(width, left + columns))
            if box[0] < box[1] and box[2] < box[3]:
                absolute, dissimilarity = _tile(
                    scratch[first], image, target, target_8bit, is_8bit, mask, is_masked, gradient,
                    with_gradient, box, height, width, l1_weight, ssim_weight,
                )  # fmt: skip
                sums[t // across, t % across, 0] = absolute
                sums[t // across, t % across, 1] = dissimilarity


def loss_terms(
    image: NDArray[np.float32],
    target: NDArray[np.float32] | NDArray[np.uint8],
    mask: NDArray[np.bool_] | None = None,
    gradient: NDArray[np.float32] | None = None,
    ssim_weight: float = 0.2,
) -> tuple[float, float]:
    """Means of |x - y| and of 1 - SSIM over the kept pixels, and the gradient by the image.

    Args:
        image: [H, W, 3], C-contiguous.
        target: [H, W, 3], C-contiguous; 8-bit values are divided by 255.
        mask: [H, W], True where the pixel counts; None keeps all.
        gradient: [H, W, 3], C-contiguous, receives the gradient of (1 - w) * L1 + w * (1 - SSIM);
            None leaves out that half of the work.
        ssim_weight: w.

    Returns:
        L1 and 1 - SSIM; both 0 if no pixel is kept.
    """
    height, width, _ = image.shape
    kept = height * width if mask is None else int(np.count_nonzero(mask))
    if kept == 0:
        if gradient is not None:
            gradient.fill(0)
        return 0.0, 0.0
    count = kept * _CHANNELS
    down, across = -(-height // _TILE_ROWS), -(-width // _TILE_COLUMNS)
    sums = np.zeros((down, across, 2))
    threads = min(get_num_threads(), down * across)
    is_8bit = target.dtype == np.uint8
    _all_tiles(
        np.zeros((threads, _SCRATCH), np.float32),
        image.reshape(-1),
        np.empty(0, np.float32) if is_8bit else target.reshape(-1).view(np.float32),
        target.reshape(-1).view(np.uint8) if is_8bit else np.empty(0, np.uint8),
        is_8bit,
        np.empty(0, np.bool_) if mask is None else mask.reshape(-1),
        mask is not None,
        np.empty(0, np.float32) if gradient is None else gradient.reshape(-1),
        gradient is not None,
        height,
        width,
        np.float32((1 - ssim_weight) / count),
        np.float32(ssim_weight / count),
        sums,
    )
    absolute, dissimilarity = sums.sum(axis=(0, 1)) / count
    return float(absolute), float(dissimilarity)
