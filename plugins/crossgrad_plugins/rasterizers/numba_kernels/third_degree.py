"""All fifteen coefficients of the higher degrees at once, in sixteen lanes.

A Gaussian's coefficients are fifteen triples (red, green, blue), 45 floats. Three vectors of five
triples and one float to spare hold them; basis functions are spread over their triples' lanes.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import WIDE, fma, load_wide, picking, store
from crossgrad_plugins.rasterizers.numba_kernels.basis import BASIS
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Basis functions of the higher degrees, and floats of their coefficients.
HIGHER = BASIS - 1
FLOATS = 3 * HIGHER

_TRIPLES = 5  # of a vector
_SECOND, _LAST = 3 * _TRIPLES, FLOATS - WIDE  # where the second and the last vector begin


def _functions(first: int) -> list[int]:
    """The basis functions of sixteen floats of the coefficients from `first` on."""
    return [1 + (first + lane) // 3 for lane in range(WIDE)]


def _channels(first: int) -> list[int]:
    return [(first + lane) % 3 for lane in range(WIDE)]


# The first vector has a float of the second one in its last lane, and so has the second one; the
# last vector has one of the second one in its first lane instead: nothing beyond the 45 is touched.
_spread_first = picking([*_functions(0)[:-1], 0])
_spread_second = picking([*_functions(_SECOND)[:-1], 0])
_spread_last = picking(_functions(_LAST))
_rgb, _rgb_last = picking(_channels(0)), picking(_channels(_LAST))
_onwards = picking([*range(1, WIDE), 0])
_six_on = picking([*range(6, WIDE), *range(6)])
#: Lanes 3 to 5 of the first vector, then 12 to 14 of the second one.
_three_on, _twelve_on = picking([3, 4, 5, *range(3, WIDE)]), picking([28, 29, 30, *range(3, WIDE)])
#: One channel of five triples of each vector: of two vectors, and then of the third.
_channel_of_two = [
    picking([*range(c, 15, 3), *range(WIDE + c, WIDE + 15, 3), *([0] * 6)]) for c in range(3)
]
_channel_of_third = [
    picking([*range(2 * _TRIPLES), *range(WIDE + c, WIDE + 15, 3), 0]) for c in range(3)
]
_red_of_two, _green_of_two, _blue_of_two = _channel_of_two
_red_of_third, _green_of_third, _blue_of_third = _channel_of_third


@device
def sum_up(
    bases: NDArray[np.float32],
    row: int,
    rest: NDArray[np.float32],
    at: int,
    colours: NDArray[np.float32],
) -> None:
    """Writes the sums of basis functions times coefficients, red, green and blue, to colours[row:].

    Args:
        bases: Basis functions from `row` on.
        row: See `bases`.
        rest: Coefficients, contiguous; those of the Gaussian begin at float `at`.
        at: See `rest`.
        colours: Sixteen floats are written, of which three count.
    """
    basis = load_wide(bases, row)
    last = load_wide(rest, at + _LAST)
    # Lanes 0 to 14 count.
    found = _spread_first(basis, basis) * load_wide(rest, at)
    found = fma(_spread_second(basis, basis), load_wide(rest, at + _SECOND), found)
    product = _spread_last(basis, basis) * last
    found = found + _onwards(product, product)
    two = found + _six_on(found, found)
    store(colours, row, (two + _three_on(two, two)) + _twelve_on(two, found))


@device
def spread(
    bases: NDArray[np.float32],
    row: int,
    v_rgb: NDArray[np.float32],
    v_rest: NDArray[np.float32],
    to: int,
) -> None:
    """Writes the gradients of the coefficients.

    Args:
        bases: As in `sum_up`, like `row`.
        row: See `bases`.
        v_rgb: The gradients of the colour, from `row` on.
        v_rest: Written from float `to` on.
        to: See `v_rest`.
    """
    basis, three = load_wide(bases, row), load_wide(v_rgb, row)
    rgb, rgb_last = _rgb(three, three), _rgb_last(three, three)
    # In this order: the float to spare of a vector is written anew by the next one.
    store(v_rest, to, _spread_first(basis, basis) * rgb)
    store(v_rest, to + _SECOND, _spread_second(basis, basis) * rgb)
    store(v_rest, to + _LAST, _spread_last(basis, basis) * rgb_last)


@device
def rest_basis_gradients(
    v_rgb: NDArray[np.float32],
    row: int,
    rest: NDArray[np.float32],
    at: int,
    v_bases: NDArray[np.float32],
) -> None:
    """Writes the gradients of the basis functions of higher degrees.

    Args:
        v_rgb: The gradients of the colour, from `row` on.
        row: See `v_rgb`.
        rest: Coefficients.
        at: Where they begin.
        v_bases: Written from `row` on: fifteen numbers, and one that does not count.
    """
    three = load_wide(v_rgb, row)
    rgb, rgb_last = _rgb(three, three), _rgb_last(three, three)
    first = load_wide(rest, at) * rgb
    second = load_wide(rest, at + _SECOND) * rgb
    product = load_wide(rest, at + _LAST) * rgb_last
    third = _onwards(product, product)
    red = _red_of_third(_red_of_two(first, second), third)
    green = _green_of_third(_green_of_two(first, second), third)
    blue = _blue_of_third(_blue_of_two(first, second), third)
    store(v_bases, row, (red + green) + blue)
