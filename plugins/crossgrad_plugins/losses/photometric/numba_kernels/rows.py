"""Loading the rows of a tile into the rings."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import part
from crossgrad_core.numerics.simd import LANES, load, splat, store, where
from crossgrad_plugins.losses.photometric.numba_kernels.layout import (
    CENTRE_DIFFERENCE,
    CENTRE_SUM,
    CHANNELS,
    DIFFERENCE,
    KEEP,
    SLOTS,
    STRIDE,
    SUM,
)
from crossgrad_plugins.losses.photometric.reference import RADIUS

_Floats: TypeAlias = NDArray[np.float32]  # 1-D
_Bytes: TypeAlias = NDArray[np.uint8]  # 1-D
_Flags: TypeAlias = NDArray[np.bool_]  # 1-D
_Box: TypeAlias = tuple[int, int, int, int]  # first row, end row, first column, end column

_ZERO, _ONE = np.float32(0), np.float32(1)
_WHITE = np.float32(255)


@part
def set_centres(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, box: _Box, width: int,
) -> None:  # fmt: skip
    """Per channel, means of s and d over every eighth row of the tile, x and y clipped."""
    top, bottom, left, right = box
    for channel in range(CHANNELS):
        count = 1e-9  # nothing kept: the sums are 0, and so are the centres
        sum_x, sum_y = 0.0, 0.0
        for row in range(top, bottom, 8):
            for column in range(left, right):
                if is_masked and not mask[row * width + column]:
                    continue
                count += 1.0
                i = (row * width + column) * CHANNELS + channel
                y = np.float32(target_8bit[i]) / _WHITE if is_8bit else target[i]
                # In this order a NaN counts as 0.
                sum_x += float(min(max(_ZERO, image[i]), _ONE))
                sum_y += float(min(max(_ZERO, y), _ONE))
        centre_sum = np.float32((sum_x + sum_y) / count)
        centre_difference = np.float32((sum_x - sum_y) / count)
        for j in range(channel, STRIDE, CHANNELS):
            scratch[CENTRE_SUM + j] = centre_sum
            scratch[CENTRE_DIFFERENCE + j] = centre_difference


# Loops over views from 0 on, because an index that may be negative keeps LLVM from vectorising.


@part
def fill(array: _Floats, start: int, count: int, value: np.float32) -> None:
    """Sets `count` elements from `start` on."""
    view = array[start : start + count]
    for j in range(count):
        view[j] = value


@part
def copy(destination: _Floats, start: int, source: _Floats, source_start: int, count: int) -> None:
    """Copies `count` elements."""
    view, values = destination[start : start + count], source[source_start : source_start + count]
    for j in range(count):
        view[j] = values[j]


@part
def _copy_8bit(
    destination: _Floats, start: int, source: _Bytes, source_start: int, count: int
) -> None:
    view, values = destination[start : start + count], source[source_start : source_start + count]
    for j in range(count):
        view[j] = np.float32(values[j]) / _WHITE


@part
def _copy_mask(
    destination: _Floats, start: int, mask: _Flags, mask_start: int, pixels: int
) -> None:
    """Each pixel's mask, once per channel, as 0 or 1."""
    view, values = destination[start : start + CHANNELS * pixels], mask[mask_start:]
    for pixel in range(pixels):
        keep = np.float32(values[pixel])
        view[3 * pixel], view[3 * pixel + 1], view[3 * pixel + 2] = keep, keep, keep


@part
def load_row(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, row: int, box: _Box, height: int, width: int,
) -> None:  # fmt: skip
    """Puts s, d (relative to their centres) and the mask of a row into the rings.

    Outside the image and at masked-out pixels both images are 0.
    """
    first = CHANNELS * (box[2] - 2 * RADIUS)  # float column of the image at the ring's column 0
    count = CHANNELS * (box[3] - box[2] + 4 * RADIUS)
    slot = (row & (SLOTS - 1)) * STRIDE
    s, d, keep = SUM + slot, DIFFERENCE + slot, KEEP + slot
    begin, end = 0, 0
    if 0 <= row < height:
        begin, end = max(0, -first), min(count, CHANNELS * width - first)
    # x and y themselves come first, and are turned into s and d in place.
    for ring in (s, d, keep):
        fill(scratch, ring, begin, _ZERO)
        fill(scratch, ring + end, count - end, _ZERO)
    source = row * CHANNELS * width + first + begin
    copy(scratch, s + begin, image, source, end - begin)
    if is_8bit:
        _copy_8bit(scratch, d + begin, target_8bit, source, end - begin)
    else:
        copy(scratch, d + begin, target, source, end - begin)
    if is_masked:
        pixels = (end - begin) // CHANNELS
        _copy_mask(scratch, keep + begin, mask, source // CHANNELS, pixels)
    else:
        fill(scratch, keep + begin, end - begin, _ONE)
    zero = splat(_ZERO)
    for j in range(0, count, LANES):
        kept = load(scratch, keep + j)
        x = where(zero < kept, load(scratch, s + j), zero)
        y = where(zero < kept, load(scratch, d + j), zero)
        store(scratch, s + j, x + y - load(scratch, CENTRE_SUM + j))
        store(scratch, d + j, x - y - load(scratch, CENTRE_DIFFERENCE + j))
