"""scikit-image's anti-aliased resize to a smaller size, row by row (Numba, CPU).

A Gaussian along the columns, one along the rows, then linear interpolation, as `transform.resize`
does through SciPy. Only rows that are interpolated are filtered, and no float image of the photo's
size exists. Every sum is taken in SciPy's order and rounded where SciPy rounds, so that the bits
are the same.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_device, strict_kernel

#: Columns that are filtered at once: what a core keeps at hand.
_BLOCK = 1024


@strict_device
def _mirrored(index: int, length: int) -> int:
    """The pixel that stands for one beyond the border; the border itself is not repeated."""
    if length == 1:
        return 0
    period = 2 * length - 2
    index %= period
    return index if index < length else period - index


@strict_device
def _add_pair(
    above: NDArray[np.uint8], below: NDArray[np.uint8], weight: float, line: NDArray[np.float64]
) -> None:
    for x in range(line.size):
        line[x] += np.float64(np.int32(np.int32(above[x]) + np.int32(below[x]))) * weight


@strict_device
def _filter_columns(
    image: NDArray[np.uint8], y: int, weights: NDArray[np.float64], line: NDArray[np.float64]
) -> None:
    """Row `y` [W C] of the image filtered along the columns, rounded to float32."""
    height, width = image.shape
    for left in range(0, width, _BLOCK):
        right = min(left + _BLOCK, width)
        part, row = line[left:right], image[y, left:right]
        for x in range(part.size):
            part[x] = row[x] * weights[0]
        for distance in range(weights.size - 1, 0, -1):
            above = image[_mirrored(y - distance, height), left:right]
            below = image[_mirrored(y + distance, height), left:right]
            _add_pair(above, below, weights[distance], part)
        for x in range(part.size):
            part[x] = np.float32(part[x])


@strict_device
def _filter_row(
    padded: NDArray[np.float64],
    channels: int,
    weights: NDArray[np.float64],
    result: NDArray[np.float64],
) -> None:
    """A row [W C] filtered along itself, rounded to float32.

    Args:
        padded: The row with as many pixels more at either end as there are weights but one, which
            are filled in.
        channels: C.
        weights: From the middle outwards.
        result: [W C].
    """
    border, width = (weights.size - 1) * channels, result.size // channels
    row = padded[border : border + result.size]
    for beyond in range(1, weights.size):
        left, right = _mirrored(-beyond, width), _mirrored(width - 1 + beyond, width)
        for channel in range(channels):
            padded[border - beyond * channels + channel] = row[left * channels + channel]
            at = border + (width - 1 + beyond) * channels + channel
            padded[at] = row[right * channels + channel]
    for begin in range(0, result.size, _BLOCK):
        part = result[begin : begin + _BLOCK]
        middle = row[begin : begin + _BLOCK]
        for x in range(part.size):
            part[x] = middle[x] * weights[0]
        for distance in range(weights.size - 1, 0, -1):
            shift, weight = distance * channels, weights[distance]
            before = padded[border + begin - shift : border + begin - shift + part.size]
            after = padded[border + begin + shift : border + begin + shift + part.size]
            for x in range(part.size):
                part[x] += (before[x] + after[x]) * weight
        for x in range(part.size):
            part[x] = np.float32(part[x])


@strict_kernel
def shrink(
    image: NDArray[np.uint8],
    along_columns: NDArray[np.float64],
    along_rows: NDArray[np.float64],
    small: NDArray[np.uint8],
) -> None:
    """Writes the image in a size that is at most its own.

    Args:
        image: [H, W C], contiguous.
        along_columns: [R + 1] weights of the Gaussian along the columns, the middle one first.
        along_rows: [S + 1] likewise along the rows.
        small: [h, w, C], h <= H and w <= W.
    """
    rows, columns, channels = small.shape
    height, width = image.shape[0], image.shape[1] // channels
    tall, wide = height / rows, width / columns
    border = (along_rows.size - 1) * channels
    padded = np.empty(width * channels + 2 * border)
    line = padded[border : border + width * channels]
    filtered = np.empty((2, width * channels))
    held = np.full(2, -1)
    for row in range(rows):
        at = (row + 0.5) * tall - 0.5
        top = int(np.floor(at))
        upper = 1.0 - (at - top)
        lower = 1.0 - upper
        for y in (top, min(top + 1, height - 1)):
            if held[y % 2] != y:
                _filter_columns(image, y, along_columns, line)
                _filter_row(padded, channels, along_rows, filtered[y % 2])
                held[y % 2] = y
        first, second = filtered[top % 2], filtered[min(top + 1, height - 1) % 2]
        for column in range(columns):
            across = (column + 0.5) * wide - 0.5
            start = int(np.floor(across))
            near = 1.0 - (across - start)
            far = 1.0 - near
            left, right = start * channels, min(start + 1, width - 1) * channels
            for channel in range(channels):
                value = first[left + channel] * upper * near
                value += first[right + channel] * upper * far
                value += second[left + channel] * lower * near
                value += second[right + channel] * lower * far
                rounded = np.rint(np.float32(value))
                small[row, column, channel] = np.uint8(min(max(rounded, 0.0), 255.0))
