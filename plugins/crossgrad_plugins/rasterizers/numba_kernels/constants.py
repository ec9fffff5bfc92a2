"""Vector constants of the compositing kernels, handed to them as an argument.

As an argument they stay operands in memory (always in the first-level cache) of the instructions
that use them. Written into the kernel they would be rebuilt in registers, which are scarce there:
that made the forward pass 15 % slower.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.rules import ALPHA_THRESHOLD, TRANSMITTANCE_STOP
from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    fma,
    load,
    scale_by_power,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COLUMNS,
    SEGMENT,
    TOUCH,
)

# 2**f on [-1/2, 1/2] by rising power: least largest relative error (9e-8) with 2**0 exact.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733953714371)
_EXP2_HIGH = (0.009671512991189957, 0.001326472032815218)
# Adding it rounds a small float32 to a whole number, left in the lowest bits of the sum.
_ROUND = 1.5 * 2.0**23

EXP2 = LANES  # six coefficients, after the rounding constant
LARGEST_ALPHA = 7 * LANES
TOUCHED = 8 * LANES
STOPPED = 9 * LANES
ONE = 10 * LANES
FINISHED = 11 * LANES
CAPPED = 12 * LANES
LEAST = 13 * LANES
OFFSETS = 14 * LANES  # pixel offsets of each column of segments


def vector_constants(max_alpha: float) -> NDArray[np.float32]:
    """Returns the constants for one cap of alpha, eight equal numbers each (offsets: 0, 1, ...)."""
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
    offsets = np.arange(COLUMNS * SEGMENT, dtype=np.float32)
    return np.concatenate([np.repeat(np.array(values, dtype=np.float32), LANES), offsets])


@device
def exp2(power: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Returns 2**power, relative error below 2e-7 for powers in [-126, 127], else anything."""
    rounder = load(constants, 0)
    shifted = power + rounder
    fraction = power - (shifted - rounder)
    square = fraction * fraction
    high = fma(load(constants, EXP2 + 5 * LANES), fraction, load(constants, EXP2 + 4 * LANES))
    middle = fma(load(constants, EXP2 + 3 * LANES), fraction, load(constants, EXP2 + 2 * LANES))
    low = fma(load(constants, EXP2 + LANES), fraction, load(constants, EXP2))
    value = fma(fma(high, square, middle), square, low)
    return scale_by_power(value, shifted)
