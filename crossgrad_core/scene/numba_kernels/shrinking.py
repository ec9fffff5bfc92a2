"""Resize images to a smaller size like scikit-image with anti-aliasing, row by row (Numba, CPU).

As in `transform.resize`, a Gaussian filter is applied along the columns and then along the rows.
The result is interpolated linearly. Only the rows that interpolation needs are filtered. A float
image in the size of the photo is not needed. Every sum uses the order and the rounding of SciPy, so
that the results are bit-identical.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_device, strict_kernel

#: Number of columns that are filtered at a time. The columns then fit into the cache of a core.
_BLOCK = 1024


@strict_device
def _mirrored(index: int, length: int) -> int:
    """Mirror a pixel index beyond the border into the image. The border pixel is not repeated."""
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
    """Filter row `y` of the image along the columns.

    The result in `line` [W C] is rounded to float32.
    """
    height, width = image.shape
    for left in range(0, width, _BLOCK):
        right = min(left + _BLOCK, width)
        segment, row = line[left:right], image[y, left:right]
        for x in range(segment.size):
            segment[x] = row[x] * weights[0]
        for distance in range(weights.size - 1, 0, -1):
            above = image[_mirrored(y - distance, height), left:right]
            below = image[_mirrored(y + distance, height), left:right]
            _add_pair(above, below, weights[distance], segment)
        for x in range(segment.size):
            segment[x] = np.float32(segment[x])


@strict_device
def _filter_row(
    padded: NDArray[np.float64],
    channels: int,
    weights: NDArray[np.float64],
    result: NDArray[np.float64],
) -> None:
    """Filter a row [W C] along its length, and round the result to float32.

    Args:
        padded: The row, with (number of weights - 1) extra pixels at each end. The function fills
            the extra pixels.
        channels: Number of channels C.
        weights: Weights of the Gaussian filter, from the middle outwards.
        result: [W C] output.
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
        segment = result[begin : begin + _BLOCK]
        middle = row[begin : begin + _BLOCK]
        for x in range(segment.size):
            segment[x] = middle[x] * weights[0]
        for distance in range(weights.size - 1, 0, -1):
            shift, weight = distance * channels, weights[distance]
            before = padded[border + begin - shift : border + begin - shift + segment.size]
            after = padded[border + begin + shift : border + begin + shift + segment.size]
            for x in range(segment.size):
                segment[x] += (before[x] + after[x]) * weight
        for x in range(segment.size):
            segment[x] = np.float32(segment[x])


@strict_device
def _columns(
    columns: int, channels: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the left and right neighbour [w C] of each output value.

    The weight of the left neighbour is the third result.
    """
    left, right = np.empty(columns * channels, np.int64), np.empty(columns * channels, np.int64)
    near = np.empty(columns * channels)
    for column in range(columns):
        across = (column + 0.5) * (width / columns) - 0.5
        start = int(np.floor(across))
        for channel in range(channels):
            x = column * channels + channel
            near[x] = 1.0 - (across - start)
            left[x] = start * channels + channel
            right[x] = min(start + 1, width - 1) * channels + channel
    return left, right, near


@strict_device
def _times(row: NDArray[np.float64], weight: float, result: NDArray[np.float64]) -> None:
    for x in range(row.size):
        result[x] = row[x] * weight


@strict_device
def _rounded(values: NDArray[np.float64], row: NDArray[np.uint8]) -> None:
    for x in range(values.size):
        row[x] = np.uint8(min(max(np.rint(np.float32(values[x])), 0.0), 255.0))


@strict_kernel
def shrink(
    image: NDArray[np.uint8],
    along_columns: NDArray[np.float64],
    along_rows: NDArray[np.float64],
    small: NDArray[np.uint8],
) -> None:
    """Resize `image` to the size of `small`, and write the result to `small`.

    Neither side may become larger.

    Args:
        image: [H, W C] image, contiguous.
        along_columns: [R + 1] weights of the Gaussian along the columns, from the middle outwards.
        along_rows: [S + 1] weights of the Gaussian along the rows, from the middle outwards.
        small: [h, w, C] output, h <= H and w <= W.
    """
    rows, columns, channels = small.shape
    height, width = image.shape[0], image.shape[1] // channels
    tall = height / rows
    border = (along_rows.size - 1) * channels
    padded = np.empty(width * channels + 2 * border)
    line = padded[border : border + width * channels]
    filtered = np.empty((2, width * channels))
    held = np.full(2, -1)
    left, right, near = _columns(columns, channels, width)
    # Buffers: the upper and the lower row, each multiplied by its weight, and the interpolated
    # values.
    above, below = np.empty(width * channels), np.empty(width * channels)
    values = np.empty(columns * channels)
    for row in range(rows):
        at = (row + 0.5) * tall - 0.5
        top = int(np.floor(at))
        upper = 1.0 - (at - top)
        for y in (top, min(top + 1, height - 1)):
            if held[y % 2] != y:
                _filter_columns(image, y, along_columns, line)
                _filter_row(padded, channels, along_rows, filtered[y % 2])
                held[y % 2] = y
        _times(filtered[top % 2], upper, above)
        _times(filtered[min(top + 1, height - 1) % 2], 1.0 - upper, below)
        for x in range(values.size):
            far = 1.0 - near[x]
            value = above[left[x]] * near[x]
            value += above[right[x]] * far
            value += below[left[x]] * near[x]
            values[x] = value + below[right[x]] * far
        _rounded(values, small[row].reshape(-1))
