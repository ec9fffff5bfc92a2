"""The rows of a tile: memory layout, loading into ring buffers, sums over windows of 11 pixels.

The channels of a row are interleaved, [column * 3 + channel], so adjacent columns are three floats
apart.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, part
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    fma,
    load,
    load_wide,
    splat,
    splat_wide,
    store,
    where,
)
from crossgrad_plugins.losses.photometric.reference import RADIUS, WINDOW, gaussian_window

TILE_ROWS = 64
TILE_COLUMNS = 384
#: Number of rows of a ring buffer. The number is a power of two and larger than WINDOW, because the
#: windows of two consecutive rows are in the buffer together.
SLOTS = 16
CHANNELS = 3
#: Number of floats from the centre column of a window to its edge.
HALO = CHANNELS * RADIUS
# Number of floats per row: a tile with twice the window's radius on both sides, and the rest of the
# last vector.
_ROOM = CHANNELS * TILE_COLUMNS + 4 * HALO + CHANNELS * WINDOW + 3 * WIDE
STRIDE = _ROOM + -_ROOM % WIDE
#: Position of the ring buffer with s minus its mean.
SUM = 0
#: Position of the ring buffer with d minus its mean.
DIFFERENCE = SUM + SLOTS * STRIDE
#: Position of the ring buffer with the mask: 1 for a pixel that counts, else 0.
KEEP = DIFFERENCE + SLOTS * STRIDE
#: Position of two rows of s, s^2, d and d^2 after the vertical filter.
PARTIAL = KEEP + SLOTS * STRIDE
#: Position of the ring buffers with a, b and c.
BY_MEAN = PARTIAL + 8 * STRIDE
BY_SUM_VARIANCE = BY_MEAN + SLOTS * STRIDE
BY_DIFFERENCE_VARIANCE = BY_SUM_VARIANCE + SLOTS * STRIDE
#: Position of two rows of a, b and c after the vertical filter.
BACK = BY_DIFFERENCE_VARIANCE + SLOTS * STRIDE
#: Position of one row of results.
LINE = BACK + 6 * STRIDE
#: Positions of the means that are subtracted from s and from d.
CENTRE_SUM = LINE + STRIDE
CENTRE_DIFFERENCE = CENTRE_SUM + STRIDE
#: Total number of floats of the memory.
SCRATCH = CENTRE_DIFFERENCE + STRIDE
_Floats: TypeAlias = NDArray[np.float32]
_Bytes: TypeAlias = NDArray[np.uint8]
_Flags: TypeAlias = NDArray[np.bool_]
_Box: TypeAlias = tuple[int, int, int, int]  # first row, end row, first column, end column
_ZERO, _ONE = np.float32(0), np.float32(1)
_WHITE = np.float32(255)


@part
def set_centres(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, box: _Box, width: int,
) -> None:  # fmt: skip
    """Write the means of s and d per channel, over every eighth row of the tile.

    x and y are clipped to [0, 1] for these means.
    """
    top, bottom, left, right = box
    for channel in range(CHANNELS):
        count = 1e-9  # If no pixel counts, this divisor makes the means 0.
        sum_x, sum_y = 0.0, 0.0
        for row in range(top, bottom, 8):
            for column in range(left, right):
                if is_masked and not mask[row * width + column]:
                    continue
                count += 1.0
                i = (row * width + column) * CHANNELS + channel
                y = np.float32(target_8bit[i]) / _WHITE if is_8bit else target[i]
                # With the arguments in this order, a NaN counts as 0.
                sum_x += float(min(max(_ZERO, image[i]), _ONE))
                sum_y += float(min(max(_ZERO, y), _ONE))
        centre_sum = np.float32((sum_x + sum_y) / count)
        centre_difference = np.float32((sum_x - sum_y) / count)
        for j in range(channel, STRIDE, CHANNELS):
            scratch[CENTRE_SUM + j] = centre_sum
            scratch[CENTRE_DIFFERENCE + j] = centre_difference


# Pass views that start at index 0 to the loops, because LLVM does not vectorise indices that can be
# negative.


@part
def fill(array: _Floats, start: int, count: int, value: np.float32) -> None:
    """Set `count` elements from `start` on to a value."""
    view = array[start : start + count]
    for j in range(count):
        view[j] = value


@part
def copy(destination: _Floats, start: int, source: _Floats, source_start: int, count: int) -> None:
    """Copy `count` elements."""
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
    """Write the mask of each pixel as 0 or 1, once for each channel."""
    view, values = destination[start : start + CHANNELS * pixels], mask[mask_start:]
    for pixel in range(pixels):
        keep = np.float32(values[pixel])
        view[3 * pixel], view[3 * pixel + 1], view[3 * pixel + 2] = keep, keep, keep


@part
def load_row(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, row: int, box: _Box, height: int, width: int,
) -> None:  # fmt: skip
    """Load s and d, minus their means, and the mask of a row into the ring buffers.

    Outside the image and at masked pixels, the values of both images are 0.
    """
    # Index of the float in the image row that belongs to column 0 of the ring buffer
    first = CHANNELS * (box[2] - 2 * RADIUS)
    count = CHANNELS * (box[3] - box[2] + 4 * RADIUS)
    slot = (row & (SLOTS - 1)) * STRIDE
    s, d, keep = SUM + slot, DIFFERENCE + slot, KEEP + slot
    begin, end = 0, 0
    if 0 <= row < height:
        begin, end = max(0, -first), min(count, CHANNELS * width - first)
    # First load x and y. Then replace them by s and d in place.
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


_Taps = tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]
_LAST = SLOTS - 1
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in gaussian_window().numpy()[: RADIUS + 1])


@device
def across(array: _Floats, start: int) -> Lanes:
    """Return the window sum over eleven columns, starting with element `start`."""
    total = load_wide(array, start + 5 * CHANNELS) * splat_wide(_W5)
    pair = load_wide(array, start + 4 * CHANNELS) + load_wide(array, start + 6 * CHANNELS)
    total = fma(pair, splat_wide(_W4), total)
    pair = load_wide(array, start + 3 * CHANNELS) + load_wide(array, start + 7 * CHANNELS)
    total = fma(pair, splat_wide(_W3), total)
    pair = load_wide(array, start + 2 * CHANNELS) + load_wide(array, start + 8 * CHANNELS)
    total = fma(pair, splat_wide(_W2), total)
    pair = load_wide(array, start + CHANNELS) + load_wide(array, start + 9 * CHANNELS)
    total = fma(pair, splat_wide(_W1), total)
    pair = load_wide(array, start) + load_wide(array, start + 10 * CHANNELS)
    return fma(pair, splat_wide(_W0), total)


@device
def _tap(ring: _Floats, start: int, row: int) -> Lanes:
    """Return the values of a row in the ring buffer from column `start` on."""
    return load_wide(ring, start + (row & _LAST) * STRIDE)


@device
def _taps(ring: _Floats, start: int, row: int) -> _Taps:
    """Return the twelve rows that belong to the windows around `row` and around the next row."""
    return (
        _tap(ring, start, row - 5),
        _tap(ring, start, row - 4),
        _tap(ring, start, row - 3),
        _tap(ring, start, row - 2),
        _tap(ring, start, row - 1),
        _tap(ring, start, row),
        _tap(ring, start, row + 1),
        _tap(ring, start, row + 2),
        _tap(ring, start, row + 3),
        _tap(ring, start, row + 4),
        _tap(ring, start, row + 5),
        _tap(ring, start, row + 6),
    )


@device
def _sum(
    a: Lanes, b: Lanes, c: Lanes, d: Lanes, e: Lanes, middle: Lanes,
    f: Lanes, g: Lanes, h: Lanes, i: Lanes, j: Lanes,
) -> Lanes:  # fmt: skip
    """Return the weighted sum of eleven rows."""
    total = middle * splat_wide(_W5)
    total = fma(e + f, splat_wide(_W4), total)
    total = fma(d + g, splat_wide(_W3), total)
    total = fma(c + h, splat_wide(_W2), total)
    total = fma(b + i, splat_wide(_W1), total)
    return fma(a + j, splat_wide(_W0), total)


@device
def _sum_squares(
    a: Lanes, b: Lanes, c: Lanes, d: Lanes, e: Lanes, middle: Lanes,
    f: Lanes, g: Lanes, h: Lanes, i: Lanes, j: Lanes,
) -> Lanes:  # fmt: skip
    """Return the weighted sum of the squares of eleven rows."""
    total = middle * middle * splat_wide(_W5)
    total = fma(fma(e, e, f * f), splat_wide(_W4), total)
    total = fma(fma(d, d, g * g), splat_wide(_W3), total)
    total = fma(fma(c, c, h * h), splat_wide(_W2), total)
    total = fma(fma(b, b, i * i), splat_wide(_W1), total)
    return fma(fma(a, a, j * j), splat_wide(_W0), total)


@device
def down(ring: _Floats, start: int, row: int) -> tuple[Lanes, Lanes]:
    """Return the window sums over rows of a ring buffer, around `row` and around the next row.

    Both sums are computed together, because they need nearly the same data from the second-level
    cache.

    Args:
        ring: Ring buffer of `SLOTS` rows.
        start: Index of the first element of the column.
        row: Number of the first row.
    """
    a, b, c, d, e, f, g, h, i, j, k, last = _taps(ring, start, row)
    return (
        _sum(a, b, c, d, e, f, g, h, i, j, k),
        _sum(b, c, d, e, f, g, h, i, j, k, last),
    )


@device
def down_with_squares(ring: _Floats, start: int, row: int) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Like `down`, but return the sums of values and of squares.

    The first two results belong to `row`, the last two to the next row.
    """
    a, b, c, d, e, f, g, h, i, j, k, last = _taps(ring, start, row)
    return (
        _sum(a, b, c, d, e, f, g, h, i, j, k),
        _sum_squares(a, b, c, d, e, f, g, h, i, j, k),
        _sum(b, c, d, e, f, g, h, i, j, k, last),
        _sum_squares(b, c, d, e, f, g, h, i, j, k, last),
    )
