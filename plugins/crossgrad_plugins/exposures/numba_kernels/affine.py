"""Affine maps of colours, and their gradients (CPU, float32, one thread)."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel

_Floats: TypeAlias = NDArray[np.float32]
_Sums: TypeAlias = NDArray[np.float64]

# Number of pixels that are summed in float32 before their sum is added in float64.
_PIXELS = 256


@kernel
def map_colors(image: _Floats, matrix: _Floats, taken: _Floats) -> None:
    """Write A x + b for the colour x of every pixel.

    Args:
        image: Values of the pixels, in the order R, G, B, R ...
        matrix: [12] the rows of [A | b], one after the other.
        taken: Output, as long as `image`.
    """
    for pixel in range(len(image) // 3):
        red, green, blue = image[3 * pixel], image[3 * pixel + 1], image[3 * pixel + 2]
        for row in range(3):
            of_colors = matrix[4 * row] * red + matrix[4 * row + 1] * green
            of_colors += matrix[4 * row + 2] * blue
            taken[3 * pixel + row] = of_colors + matrix[4 * row + 3]


@kernel
def map_colors_back(
    image: _Floats, matrix: _Floats, upstream: _Floats, gradient: _Floats, sums: _Sums
) -> None:
    """Write the gradient with respect to the colours, and add up the one for the matrix.

    Args:
        image: The image, as for `map_colors`.
        matrix: [12], as for `map_colors`.
        upstream: The gradient with respect to the output of `map_colors`.
        gradient: Output: the gradient with respect to the colours.
        sums: [3, 4] output: the gradient with respect to [A | b]; must be zero at the start.
    """
    partial = np.zeros((3, 4), dtype=np.float32)
    pixels = len(image) // 3
    for first in range(0, pixels, _PIXELS):
        for pixel in range(first, min(pixels, first + _PIXELS)):
            red, green, blue = image[3 * pixel], image[3 * pixel + 1], image[3 * pixel + 2]
            for row in range(3):
                given = upstream[3 * pixel + row]
                partial[row, 0] += given * red
                partial[row, 1] += given * green
                partial[row, 2] += given * blue
                partial[row, 3] += given
                back = matrix[row] * upstream[3 * pixel]
                back += matrix[4 + row] * upstream[3 * pixel + 1]
                gradient[3 * pixel + row] = back + matrix[8 + row] * upstream[3 * pixel + 2]
        for row in range(3):
            for column in range(4):
                sums[row, column] += np.float64(partial[row, column])
                partial[row, column] = np.float32(0)
