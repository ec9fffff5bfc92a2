"""Vector constants of the compositing kernels, handed to them as an argument.

As an argument they stay operands in memory (always in the first-level cache) of the instructions
that use them. Written into the kernel they would be rebuilt in registers, which are scarce there:
that made the forward pass 15 % slower.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, TRANSMITTANCE_STOP
from crossgrad_core.numerics.simd import (
    WIDE,
    Lanes,
    fma,
    load_wide,
    scale_by_power,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    MIDDLE,
    SIDE,
    TILE_WIDTH,
    TOUCH,
)

# 2**f on [-1/2, 1/2] by rising power: least largest relative error (9e-8) with 2**0 exact.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733953714371)
_EXP2_HIGH = (0.009671512991189957, 0.001326472032815218)
# Adding it rounds a small float32 to a whole number, left in the lowest bits of the sum.
_ROUND = 1.5 * 2.0**23

EXP2 = WIDE  # six coefficients, after the rounding constant
LARGEST_ALPHA = 7 * WIDE
TOUCHED = 8 * WIDE
STOPPED = 9 * WIDE
ONE = 10 * WIDE
FINISHED = 11 * WIDE
FIXED = FINISHED  # the odds of an alpha that no parameter changes
CAPPED = 12 * WIDE
LEAST = 13 * WIDE
OFFSETS = 14 * WIDE  # pixel offsets from the middle, by columns of patches

#: What `exp2` needs.
Terms = tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]


@lru_cache(maxsize=8)
def vector_constants(max_alpha: float) -> NDArray[np.float32]:
    """Returns the constants for one cap of alpha, WIDE equal numbers each but for the offsets.

    One array for each cap, which is only read.
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
    # From the beginning of a cache line on: no vector lies across two.
    found = room[shift : shift + len(flat)]
    found[:] = flat
    return found


@device
def terms_of(constants: NDArray[np.float32]) -> Terms:
    """Returns what `exp2` needs.

    Loaded before a loop it stays in registers where there are 32 of them.
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
    """Returns 2**power, relative error below 2e-7 for powers in [-126, 127], else anything."""
    rounder, c0, c1, c2, c3, c4, c5 = terms
    shifted = power + rounder
    fraction = power - (shifted - rounder)
    square = fraction * fraction
    high, middle, low = fma(c5, fraction, c4), fma(c3, fraction, c2), fma(c1, fraction, c0)
    value = fma(fma(high, square, middle), square, low)
    return scale_by_power(value, shifted)
