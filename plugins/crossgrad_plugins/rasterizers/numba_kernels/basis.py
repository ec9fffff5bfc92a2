"""Real spherical harmonics (SH) up to degree 3, for sixteen directions at once.

LLVM vectorises loops over the directions if they have no branches. Each component of the directions
therefore has a row of sixteen numbers. The kernels for coefficients need all numbers of one
direction next to each other, so `turned` transposes the rows.

The coefficients of a Gaussian above degree 0 are fifteen triples (red, green, blue), 45 floats.
They are stored in three vectors of sixteen lanes, each with five triples and one unused float. A
basis function is copied to the three lanes of its triple.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import WIDE, fma, load_wide, picking, store
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Number of floats for x, y, z and the inverse distances of sixteen directions.
WAYS = 4 * WIDE
#: Number of basis functions of all degrees, which equals the number of lanes of a vector. Number of
#: floats for the basis functions of sixteen directions.
BASIS = WIDE
TABLE = BASIS * WIDE
_X, _Y, _Z, _INVERSE = 0, WIDE, 2 * WIDE, 3 * WIDE
C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
_C2_XY = 1.0925484305920792  # sqrt(15 / (4 pi))
_C2_ZZ = 0.31539156525252005  # sqrt(5 / (16 pi))
_C2_XX = 0.5462742152960396  # sqrt(15 / (16 pi))
_C3_XXX = 0.5900435899266435  # sqrt(35 / (32 pi))
_C3_XYZ = 2.890611442640554  # sqrt(105 / (4 pi))
_C3_XZZ = 0.4570457994644658  # sqrt(21 / (32 pi))
_C3_ZZZ = 0.3731763325901154  # sqrt(7 / (16 pi))
_C3_XXZ = 1.445305721320277  # sqrt(105 / (16 pi))
# In each step of the transposition, two rows exchange blocks of lanes. The first group of
# permutations gives the new first row, and the second group gives the new second row.
_first_1, _first_2, _first_4, _first_8 = (
    picking([WIDE + lane - s if lane & s else lane for lane in range(WIDE)]) for s in (1, 2, 4, 8)
)
_second_1, _second_2, _second_4, _second_8 = (
    picking([WIDE + lane if lane & s else lane + s for lane in range(WIDE)]) for s in (1, 2, 4, 8)
)


@device
def put_way(
    means: NDArray[np.float32], i: int, eye: NDArray[np.float64], ways: NDArray[np.float64], j: int
) -> None:
    """Write the vector from the camera to Gaussian i as number j of the rows x, y and z."""
    ways[j + _X] = np.float64(means[i, 0]) - eye[0]
    ways[j + _Y] = np.float64(means[i, 1]) - eye[1]
    ways[j + _Z] = np.float64(means[i, 2]) - eye[2]


@device
def normalize(ways: NDArray[np.float64]) -> None:
    """Normalise sixteen vectors, and write their inverse lengths."""
    for j in range(WIDE):
        x, y, z = ways[j + _X], ways[j + _Y], ways[j + _Z]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        ways[j + _X], ways[j + _Y], ways[j + _Z] = x * inverse, y * inverse, z * inverse
        ways[j + _INVERSE] = inverse


@device
def basis_of(degree: int, ways: NDArray[np.float64], table: NDArray[np.float32]) -> None:
    """Write the basis functions of degrees 0 to `degree` for sixteen unit vectors, one row each."""
    for j in range(WIDE):
        table[j] = C0
    if degree < 1:
        return
    for j in range(WIDE):
        x, y, z = ways[j + _X], ways[j + _Y], ways[j + _Z]
        table[j + WIDE] = -_C1 * y
        table[j + 2 * WIDE] = _C1 * z
        table[j + 3 * WIDE] = -_C1 * x
    if degree < 2:
        return
    for j in range(WIDE):
        x, y, z = ways[j + _X], ways[j + _Y], ways[j + _Z]
        xx, yy, zz = x * x, y * y, z * z
        table[j + 4 * WIDE] = _C2_XY * x * y
        table[j + 5 * WIDE] = -_C2_XY * y * z
        table[j + 6 * WIDE] = _C2_ZZ * (2.0 * zz - xx - yy)
        table[j + 7 * WIDE] = -_C2_XY * x * z
        table[j + 8 * WIDE] = _C2_XX * (xx - yy)
    if degree < 3:
        return
    for j in range(WIDE):
        x, y, z = ways[j + _X], ways[j + _Y], ways[j + _Z]
        xx, yy, zz = x * x, y * y, z * z
        table[j + 9 * WIDE] = -_C3_XXX * y * (3.0 * xx - yy)
        table[j + 10 * WIDE] = _C3_XYZ * x * y * z
        table[j + 11 * WIDE] = -_C3_XZZ * y * (4.0 * zz - xx - yy)
        table[j + 12 * WIDE] = _C3_ZZZ * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
        table[j + 13 * WIDE] = -_C3_XZZ * x * (4.0 * zz - xx - yy)
        table[j + 14 * WIDE] = _C3_XXZ * z * (xx - yy)
        table[j + 15 * WIDE] = -_C3_XXX * x * (xx - 3.0 * yy)


@device
def pull_ways(degree: int, v: NDArray[np.float32], ways: NDArray[np.float64]) -> None:
    """Replace sixteen unit vectors by the gradients of sum(v * basis) with respect to the vectors.

    Args:
        degree: Active SH degree.
        v: Gradients with respect to the basis functions of degree 1 and higher, one row each.
        ways: The result of `normalize`; the rows x, y and z are replaced.
    """
    for j in range(WIDE):
        x, y, z = ways[j + _X], ways[j + _Y], ways[j + _Z]
        # These derivatives treat x, y and z as independent variables.
        v_x = v_y = v_z = 0.0
        if degree >= 1:
            v_x, v_y, v_z = -_C1 * v[j + 2 * WIDE], -_C1 * v[j], _C1 * v[j + WIDE]
        if degree >= 2:
            a, b, c = _C2_XY * v[j + 3 * WIDE], -_C2_XY * v[j + 4 * WIDE], -_C2_XY * v[j + 6 * WIDE]
            d, e = 2.0 * _C2_XX * v[j + 7 * WIDE], 2.0 * _C2_ZZ * v[j + 5 * WIDE]
            v_x += a * y + c * z + d * x - e * x
            v_y += a * x + b * z - d * y - e * y
            v_z += b * y + c * x + 2.0 * e * z
        if degree >= 3:
            xx, yy, zz = x * x, y * y, z * z
            f, g, h = (
                -_C3_XXX * v[j + 8 * WIDE],
                _C3_XYZ * v[j + 9 * WIDE],
                -_C3_XZZ * v[j + 10 * WIDE],
            )
            k, m, n = (
                _C3_ZZZ * v[j + 11 * WIDE],
                -_C3_XZZ * v[j + 12 * WIDE],
                _C3_XXZ * v[j + 13 * WIDE],
            )
            p = -_C3_XXX * v[j + 14 * WIDE]
            v_x += f * 6.0 * x * y + g * y * z - h * 2.0 * x * y - k * 6.0 * x * z
            v_x += m * (4.0 * zz - 3.0 * xx - yy) + n * 2.0 * x * z + p * 3.0 * (xx - yy)
            v_y += (
                f * 3.0 * (xx - yy) + g * x * z + h * (4.0 * zz - xx - 3.0 * yy) - k * 6.0 * y * z
            )
            v_y += -m * 2.0 * x * y - n * 2.0 * y * z - p * 6.0 * x * y
            v_z += g * x * y + h * 8.0 * y * z + k * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            v_z += m * 8.0 * x * z + n * (xx - yy)
        along = x * v_x + y * v_y + z * v_z
        inverse = ways[j + _INVERSE]
        ways[j + _X] = (v_x - x * along) * inverse
        ways[j + _Y] = (v_y - y * along) * inverse
        ways[j + _Z] = (v_z - z * along) * inverse


@device
def turned(source: NDArray[np.float32], target: NDArray[np.float32]) -> None:
    """Transpose sixteen rows of sixteen numbers."""
    for r in range(0, WIDE, 2):
        a, b = load_wide(source, r * WIDE), load_wide(source, (r + 1) * WIDE)
        store(target, r * WIDE, _first_1(a, b))
        store(target, (r + 1) * WIDE, _second_1(a, b))
    for group in range(0, WIDE, 4):
        for r in range(group, group + 2):
            a, b = load_wide(target, r * WIDE), load_wide(target, (r + 2) * WIDE)
            store(target, r * WIDE, _first_2(a, b))
            store(target, (r + 2) * WIDE, _second_2(a, b))
    for group in range(0, WIDE, 8):
        for r in range(group, group + 4):
            a, b = load_wide(target, r * WIDE), load_wide(target, (r + 4) * WIDE)
            store(target, r * WIDE, _first_4(a, b))
            store(target, (r + 4) * WIDE, _second_4(a, b))
    for r in range(8):
        a, b = load_wide(target, r * WIDE), load_wide(target, (r + 8) * WIDE)
        store(target, r * WIDE, _first_8(a, b))
        store(target, (r + 8) * WIDE, _second_8(a, b))


#: Number of basis functions of degree 1 and higher, and number of floats of their coefficients.
HIGHER = BASIS - 1
FLOATS = 3 * HIGHER
_TRIPLES = 5  # number of coefficient floats per vector
_SECOND, _LAST = 3 * _TRIPLES, FLOATS - WIDE  # starts of the second and of the last vector


def _functions(first: int) -> list[int]:
    """Return the basis functions for sixteen coefficient floats, starting with float `first`."""
    return [1 + (first + lane) // 3 for lane in range(WIDE)]


def _channels(first: int) -> list[int]:
    return [(first + lane) % 3 for lane in range(WIDE)]


# The first two vectors read sixteen floats each, so their last lane belongs to the next vector. The
# third vector starts one float earlier, so that nothing beyond the 45 floats is read or written.
_spread_first = picking([*_functions(0)[:-1], 0])
_spread_second = picking([*_functions(_SECOND)[:-1], 0])
_spread_last = picking(_functions(_LAST))
_rgb, _rgb_last = picking(_channels(0)), picking(_channels(_LAST))
_onwards = picking([*range(1, WIDE), 0])
_six_on = picking([*range(6, WIDE), *range(6)])
#: Lanes 3 to 5 of the first vector, followed by lanes 12 to 14 of the second vector.
_three_on, _twelve_on = picking([3, 4, 5, *range(3, WIDE)]), picking([28, 29, 30, *range(3, WIDE)])
#: Select one channel of the five triples of each vector: first from two vectors, then from the
#: third.
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
    """Write the sums of basis functions times coefficients (red, green, blue) to `colours`.

    Args:
        bases: Basis functions, starting with number `row`.
        row: Index of the first number that is read from `bases`.
        rest: SH coefficients, contiguous.
        at: Index of the first float of the Gaussian's coefficients in `rest`.
        colours: Output from index `row` on; sixteen floats are written, and only the first three
            have a meaning.
    """
    basis = load_wide(bases, row)
    last = load_wide(rest, at + _LAST)
    # Only lanes 0 to 14 are used.
    partial_sums = _spread_first(basis, basis) * load_wide(rest, at)
    partial_sums = fma(_spread_second(basis, basis), load_wide(rest, at + _SECOND), partial_sums)
    product = _spread_last(basis, basis) * last
    partial_sums = partial_sums + _onwards(product, product)
    two = partial_sums + _six_on(partial_sums, partial_sums)
    store(colours, row, (two + _three_on(two, two)) + _twelve_on(two, partial_sums))


@device
def spread(
    bases: NDArray[np.float32],
    row: int,
    v_rgb: NDArray[np.float32],
    v_rest: NDArray[np.float32],
    to: int,
) -> None:
    """Write the gradients with respect to the coefficients.

    Args:
        bases: Basis functions, starting with number `row`.
        row: Index of the first number that is read from `bases` and `v_rgb`.
        v_rgb: The gradients with respect to the colour, starting with number `row`.
        v_rest: Output, written from float `to` on.
        to: Index of the first float of `v_rest` that is written.
    """
    basis, three = load_wide(bases, row), load_wide(v_rgb, row)
    rgb, rgb_last = _rgb(three, three), _rgb_last(three, three)
    # Keep this order, because each vector writes one unused float that the next vector overwrites.
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
    """Write the gradients with respect to the basis functions of degree 1 and higher.

    Args:
        v_rgb: The gradients with respect to the colour, starting with number `row`.
        row: Index of the first number that is read from `v_rgb` and written to `v_bases`.
        rest: SH coefficients, contiguous.
        at: Index of the first float of the Gaussian's coefficients in `rest`.
        v_bases: Output from `row` on: fifteen numbers and one unused number.
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
