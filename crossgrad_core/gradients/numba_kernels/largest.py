"""The largest magnitude in an array, as its bits (Numba, CPU, float32)."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, take

_ALL_BUT_SIGN = np.uint32(0x7FFFFFFF)


@kernel
def largest_bits(jobs: Jobs, bits: NDArray[np.uint32], found: NDArray[np.uint32]) -> None:
    """Of numbers of one sign the larger has the larger bits; infinity and NaN come last.

    Args:
        jobs: From `share`.
        bits: [N] of the numbers.
        found: [parts] written: the largest in each of as many parts.
    """
    parts = len(found)
    part = take(jobs, parts)
    while part < parts:
        most = np.uint32(0)
        for i in range(part * len(bits) // parts, (part + 1) * len(bits) // parts):
            most = max(most, bits[i] & _ALL_BUT_SIGN)
        found[part] = most
        part = take(jobs, parts)
