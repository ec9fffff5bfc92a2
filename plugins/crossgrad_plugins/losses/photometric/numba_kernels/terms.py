"""SSIM, its derivatives and the gradient of the loss, for one or two rows of a tile."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import part, sum_kernel
from crossgrad_core.numerics.simd import WIDE, fma, fnma, load_wide, splat_wide, store, where
from crossgrad_plugins.losses.photometric.numba_kernels.rows import (
    BACK,
    BY_DIFFERENCE_VARIANCE,
    BY_MEAN,
    BY_SUM_VARIANCE,
    CENTRE_DIFFERENCE,
    CENTRE_SUM,
    CHANNELS,
    DIFFERENCE,
    HALO,
    KEEP,
    LINE,
    PARTIAL,
    SLOTS,
    STRIDE,
    SUM,
    across,
    down,
    down_with_squares,
    fill,
)
from crossgrad_plugins.losses.photometric.reference import C1, C2, RADIUS

_Floats: TypeAlias = NDArray[np.float32]

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_TWICE_C1, _TWICE_C2 = np.float32(2 * C1), np.float32(2 * C2)


@part
def sum_rows(scratch: _Floats, row: int, columns: int) -> None:
    """Sum s, s^2, d and d^2 over the windows around a row and around the next row."""
    for j in range(0, CHANNELS * (columns + 4 * RADIUS), WIDE):
        values, squares, next_values, next_squares = down_with_squares(scratch, SUM + j, row)
        store(scratch, PARTIAL + j, values)
        store(scratch, PARTIAL + STRIDE + j, squares)
        store(scratch, PARTIAL + 4 * STRIDE + j, next_values)
        store(scratch, PARTIAL + 5 * STRIDE + j, next_squares)
        values, squares, next_values, next_squares = down_with_squares(scratch, DIFFERENCE + j, row)
        store(scratch, PARTIAL + 2 * STRIDE + j, values)
        store(scratch, PARTIAL + 3 * STRIDE + j, squares)
        store(scratch, PARTIAL + 6 * STRIDE + j, next_values)
        store(scratch, PARTIAL + 7 * STRIDE + j, next_squares)


@part
def ssim_row(scratch: _Floats, row: int, columns: int, partial: int) -> None:
    """Write 1 - SSIM of a row to the output line, and a, b, c to their ring buffers.

    Pixels that do not count get the value 0. The vertical sums of this row begin at element
    `partial`.
    """
    slot = (row & (SLOTS - 1)) * STRIDE
    zero, one, two = splat_wide(_ZERO), splat_wide(_ONE), splat_wide(_TWO)
    twice_c1, twice_c2 = splat_wide(_TWICE_C1), splat_wide(_TWICE_C2)
    for j in range(0, CHANNELS * (columns + 2 * RADIUS), WIDE):
        keep = load_wide(scratch, KEEP + slot + HALO + j)
        local_s = across(scratch, partial + j)
        local_d = across(scratch, partial + 2 * STRIDE + j)
        variance_s = fnma(local_s, local_s, across(scratch, partial + STRIDE + j))
        variance_d = fnma(local_d, local_d, across(scratch, partial + 3 * STRIDE + j))
        # Rounding can make a variance of zero slightly negative.
        variance_s = where(zero < variance_s, variance_s, zero) + twice_c2
        variance_d = where(zero < variance_d, variance_d, zero)
        mean_s = local_s + load_wide(scratch, CENTRE_SUM + j)
        mean_d = local_d + load_wide(scratch, CENTRE_DIFFERENCE + j)
        bright = fma(mean_s, mean_s, twice_c1)
        dark = mean_d * mean_d
        over_mean = one / (bright + dark)
        over_variance = one / (variance_s + variance_d)
        # One minus the luminance term, and one minus the contrast-structure term. Both values are
        # exactly 0 if x = y.
        luminance_loss = two * dark * over_mean
        contrast_loss = two * variance_d * over_variance
        dissimilarity = fnma(luminance_loss, contrast_loss, luminance_loss + contrast_loss)
        store(scratch, LINE + j, where(zero < keep, dissimilarity, zero))
        by_variance = two * (one - luminance_loss) * over_variance * over_variance
        by_sum = by_variance * variance_d
        by_difference = zero - by_variance * variance_s
        by_mean = two * two * (one - contrast_loss) * over_mean * over_mean
        by_mean = by_mean * fnma(mean_d, bright, mean_s * dark)
        by_mean = fnma(two, fma(local_s, by_sum, local_d * by_difference), by_mean)
        store(scratch, BY_MEAN + slot + j, where(zero < keep, by_mean, zero))
        store(scratch, BY_SUM_VARIANCE + slot + j, where(zero < keep, two * by_sum, zero))
        store(
            scratch,
            BY_DIFFERENCE_VARIANCE + slot + j,
            where(zero < keep, two * by_difference, zero),
        )


@part
def clear_row(scratch: _Floats, row: int, columns: int) -> None:
    """Set a, b and c of a row outside the image to 0."""
    slot = (row & (SLOTS - 1)) * STRIDE
    for ring in (BY_MEAN, BY_SUM_VARIANCE, BY_DIFFERENCE_VARIANCE):
        fill(scratch, ring + slot, CHANNELS * (columns + 2 * RADIUS), _ZERO)


@part
def sum_gradient_rows(scratch: _Floats, row: int, columns: int) -> None:
    """Sum a, b and c over the windows around a row and around the next row."""
    for j in range(0, CHANNELS * (columns + 2 * RADIUS), WIDE):
        this, below = down(scratch, BY_MEAN + j, row)
        store(scratch, BACK + j, this)
        store(scratch, BACK + 3 * STRIDE + j, below)
        this, below = down(scratch, BY_SUM_VARIANCE + j, row)
        store(scratch, BACK + STRIDE + j, this)
        store(scratch, BACK + 4 * STRIDE + j, below)
        this, below = down(scratch, BY_DIFFERENCE_VARIANCE + j, row)
        store(scratch, BACK + 2 * STRIDE + j, this)
        store(scratch, BACK + 5 * STRIDE + j, below)


@part
def gradient_row(
    scratch: _Floats,
    row: int,
    columns: int,
    back: int,
    l1_weight: np.float32,
    ssim_weight: np.float32,
) -> None:
    """Write the gradient of the loss for a row of the tile to the output line.

    The vertical sums of this row begin at element `back`.
    """
    slot = (row & (SLOTS - 1)) * STRIDE + 2 * HALO
    zero, plus, weight = splat_wide(_ZERO), splat_wide(l1_weight), splat_wide(ssim_weight)
    minus = zero - plus
    for j in range(0, CHANNELS * columns, WIDE):
        s = load_wide(scratch, SUM + slot + j)
        d = load_wide(scratch, DIFFERENCE + slot + j)
        difference = d + load_wide(scratch, CENTRE_DIFFERENCE + j)
        ssim = across(scratch, back + j)
        ssim = fma(s, across(scratch, back + STRIDE + j), ssim)
        ssim = fma(d, across(scratch, back + 2 * STRIDE + j), ssim)
        l1 = where(zero < difference, plus, where(zero < zero - difference, minus, zero))
        keep = load_wide(scratch, KEEP + slot + j)
        store(scratch, LINE + j, where(zero < keep, fnma(ssim, weight, l1), zero))


@sum_kernel
def sum_of(array: _Floats, start: int, count: int) -> float:
    """Return the sum of `count` elements in float64."""
    view = array[start : start + count]
    total = 0.0
    for j in range(count):
        total += np.float64(view[j])
    return total


@sum_kernel
def sum_absolute(scratch: _Floats, start: int, count: int) -> float:
    """Return the sum of |d| over `count` elements from `start` on.

    The subtracted means are added to d before. The element at `start` must be the first channel of
    a pixel.
    """
    view, centre = scratch[start : start + count], scratch[CENTRE_DIFFERENCE:]
    total = 0.0
    for j in range(count):
        total += np.float64(abs(view[j] + centre[j]))
    return total
