"""Reduce an image: each new pixel is the mean of an area of the image (Numba, CPU)."""

from math import ceil

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel

#: A new pixel is valid if at least this share of its area consists of valid pixels.
_COUNTS = 0.5


@kernel
def reduce_by_area(
    image: NDArray[np.uint8],
    kept: NDArray[np.bool_],
    small: NDArray[np.uint8],
    counts: NDArray[np.bool_],
) -> None:
    """Write the mean of the area of each new pixel.

    The order of all sums is fixed, so that results are repeatable.

    Args:
        image: [H, 3 W] rows of interleaved RGB values, contiguous.
        kept: [H, W] True for valid pixels; shape [0, 0] if all pixels are valid.
        small: [h, w, 3] output, h <= H and w <= W: the mean over valid pixels, or 0 without a valid
            pixel.
        counts: [h, w] output, True for valid new pixels.
    """
    masked = kept.size > 0
    rows, columns = counts.shape
    height, width = image.shape[0], image.shape[1] // 3
    tall, wide = height / rows, width / columns
    total, cover = np.empty(3 * width), np.empty(width)
    for row in range(rows):
        top, bottom = row * tall, min((row + 1) * tall, float(height))
        total[:] = 0.0
        cover[:] = 0.0 if masked else bottom - top
        for y in range(int(top), ceil(bottom)):
            share = min(bottom, y + 1.0) - max(top, float(y))
            if masked:
                for x in range(width):
                    area = share * kept[y, x]
                    cover[x] += area
                    for channel in range(3 * x, 3 * x + 3):
                        total[channel] += area * image[y, channel]
            else:
                for channel in range(3 * width):
                    total[channel] += share * image[y, channel]
        for column in range(columns):
            left, right = column * wide, min((column + 1) * wide, float(width))
            red, green, blue, area = 0.0, 0.0, 0.0, 0.0
            for x in range(int(left), ceil(right)):
                share = min(right, x + 1.0) - max(left, float(x))
                area += share * cover[x]
                red += share * total[3 * x]
                green += share * total[3 * x + 1]
                blue += share * total[3 * x + 2]
            mean = 1.0 / area if area > 0.0 else 0.0
            small[row, column, 0] = np.uint8(np.rint(red * mean))
            small[row, column, 1] = np.uint8(np.rint(green * mean))
            small[row, column, 2] = np.uint8(np.rint(blue * mean))
            counts[row, column] = area >= _COUNTS * tall * wide
