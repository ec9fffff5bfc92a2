"""Sizes, the layout of a Gaussian's record, and vector constants of the kernels.

The 2-D Gaussian is stored by rows of pixels, because this form is precise even for very thin
Gaussians. Let [[A, B], [B, C]] be the (dilated) covariance, and let dy and dx be the row and column
offset from the mean:

    exponent = -(dy^2 / C + (dx - k dy)^2 / V) / 2,   k = B / C,   V = (A C - B^2) / C,

so a row is a 1-D Gaussian of variance V with the centre k dy. Exponents are in units of log 2.

Vector constants are passed to the kernels as an argument. The compiler then reads the constants
from memory, that is, from the first-level cache. Constants in the source code of a kernel would
occupy vector registers. There are few of them, so the forward pass would be slower.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, TRANSMITTANCE_STOP
from crossgrad_core.numerics.simd import WIDE, Lanes, fma, load_wide, scale_by_power
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Width and height of a tile, in pixels.
TILE_WIDTH = 64
TILE_HEIGHT = 16
#: A patch contains 4 x 4 pixels, which are processed together in a vector. The lanes of the vector
#: are the pixels column by column, so that values that are common to a row can be loaded directly.
#: The patches of a tile are numbered row by row. A tile has as many patches as an integer has bits,
#: so that an integer can represent a set of patches.
SIDE = 4
COLUMNS = TILE_WIDTH // SIDE
#: Columns are counted from this column in the middle of a tile. Offsets from the middle are
#: smaller, so that float32 positions are more precise.
MIDDLE = TILE_WIDTH // 2
PATCHES = COLUMNS * TILE_HEIGHT // SIDE
#: Number of Gaussians that one job of the projection handles.
CHUNK = 2048
#: Number of floats in a record (one cache line), followed by the positions of the record's fields.
RECORD = 16
U_WHOLE, U_PART = 0, 1  # projected mean in pixels: whole part and fractional part
V_WHOLE, V_PART = 2, 3
SLOPE = 4  # the slope k
ROW_DECAY = 5  # log2(e) / (2 C)
DECAY = 6  # log2(e) / (2 V)
WIDTH = 7  # inverse of DECAY
LOG_OPACITY = 8  # log2 of the opacity, multiplied by the antialiasing factor
RED, GREEN, BLUE = 9, 10, 11
DEPTH = 12
#: Fields of a record of the analytic response. They use the positions of the fields SLOPE to
#: LOG_OPACITY.
COSINE, SINE = 4, 5  # cosine and sine of the angle of the longer main axis
INVERSE_1, INVERSE_2 = 6, 7  # inverse standard deviation along each main axis, 1 / pixels
PEAK = 8  # opacity times 2 pi times both standard deviations
REACH_1, REACH_2 = 13, 14  # offsets along the main axes beyond which no pixel is touched, pixels
RADIUS = 15  # squared limit for both axes together, in standard deviations beyond half a pixel
#: Number of sums over pixels that the backward pass writes for each drawn Gaussian and tile.
PARTIAL = 16
SUM_1, SUM_D, SUM_Y, SUM_DD, SUM_YY, SUM_DY = 0, 1, 2, 3, 4, 5
SUM_RED, SUM_GREEN, SUM_BLUE = 6, 7, 8
SUM_DEPTH = 9
SUM_ABS_X, SUM_ABS_Y = 10, 11
#: Sums of the analytic response. They use the positions of the sums SUM_D to SUM_DY.
SUM_U, SUM_V, SUM_SIGMA_1, SUM_SIGMA_2, SUM_TURN = 1, 2, 3, 4, 5
LOG2_E = 1.0 / math.log(2.0)
#: A pixel is touched if the exponent plus log2 of the opacity is at least this value.
TOUCH = math.log2(ALPHA_THRESHOLD)
#: Row extents are enlarged by this value, so that rounding does not lose a touched pixel.
SPARE = 1e-4
# Coefficients of a polynomial for 2**f on [-1/2, 1/2], from low to high power. They minimise the
# maximum relative error (9e-8); 2**0 is exact.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733953714371)
_EXP2_HIGH = (0.009671512991189957, 0.001326472032815218)
# Adding this number rounds a small float32 number to a whole number. The lowest bits of the sum
# then contain the whole number.
_ROUND = 1.5 * 2.0**23
EXP2 = WIDE  # six coefficients, after the rounding constant
LARGEST_ALPHA = 7 * WIDE
TOUCHED = 8 * WIDE
STOPPED = 9 * WIDE
ONE = 10 * WIDE
FINISHED = 11 * WIDE
# marker that replaces the odds of a capped alpha, because a capped alpha does not depend on
# parameters
FIXED = FINISHED
CAPPED = 12 * WIDE
LEAST = 13 * WIDE
OFFSETS = 14 * WIDE  # pixel offsets from the middle column, by columns of patches
#: The constants that `exp2` needs.
Terms = tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]


@lru_cache(maxsize=8)
def vector_constants(max_alpha: float) -> NDArray[np.float32]:
    """Return the constants for one cap of alpha.

    Each constant is repeated WIDE times, except the pixel offsets. All calls with one cap return
    the same array, so callers must not write to it.
    """
    shared = (
        max_alpha,
        TOUCH,
        TRANSMITTANCE_STOP,
        1.0,
        -1.0,
        math.log2(max_alpha),
        ALPHA_THRESHOLD,
    )
    values = (_ROUND, *_EXP2, *_EXP2_HIGH, *shared)
    offsets = np.repeat(np.arange(TILE_WIDTH, dtype=np.float32) - np.float32(MIDDLE), SIDE)
    flat = np.concatenate([np.repeat(np.array(values, dtype=np.float32), WIDE), offsets])
    room = np.empty(len(flat) + WIDE, np.float32)
    shift = -(room.ctypes.data // room.itemsize) % WIDE
    # Start the array at a cache line, so that no vector extends over two lines.
    constants = room[shift : shift + len(flat)]
    constants[:] = flat
    return constants


@device
def terms_of(constants: NDArray[np.float32]) -> Terms:
    """Return the constants of `exp2`.

    If the constants are loaded before a loop, they stay in registers on machines with 32 vector
    registers.
    """
    return (
        load_wide(constants, 0),
        load_wide(constants, EXP2),
        load_wide(constants, EXP2 + WIDE),
        load_wide(constants, EXP2 + 2 * WIDE),
        load_wide(constants, EXP2 + 3 * WIDE),
        load_wide(constants, EXP2 + 4 * WIDE),
        load_wide(constants, EXP2 + 5 * WIDE),
    )


@device
def exp2(power: Lanes, terms: Terms) -> Lanes:
    """Return 2**power with a relative error below 2e-7.

    The result is valid for powers in [-126, 127].
    """
    rounder, c0, c1, c2, c3, c4, c5 = terms
    shifted = power + rounder
    fraction = power - (shifted - rounder)
    square = fraction * fraction
    high, middle, low = fma(c5, fraction, c4), fma(c3, fraction, c2), fma(c1, fraction, c0)
    value = fma(fma(high, square, middle), square, low)
    return scale_by_power(value, shifted)
