"""The largest magnitude in an array, as its bits (Numba, CPU, float32)."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel

_ALL_BUT_SIGN = np.uint32(0x7FFFFFFF)


@kernel
def largest_bits(bits: NDArray[np.uint32]) -> np.uint32:
    """Of numbers of one sign the larger has the larger bits; infinity and NaN come last."""
    most = np.uint32(0)
    for i in range(len(bits)):
        most = max(most, bits[i] & _ALL_BUT_SIGN)
    return most
