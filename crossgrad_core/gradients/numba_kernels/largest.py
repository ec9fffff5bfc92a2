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
        own = bits[part * len(bits) // parts : (part + 1) * len(bits) // parts]
        # Four runs at a time: memory is waited for less than with one.
        quarter = len(own) // 4
        p, q = own[:quarter], own[quarter : 2 * quarter]
        r, s = own[2 * quarter : 3 * quarter], own[3 * quarter : 4 * quarter]
        of_p = of_q = of_r = of_s = np.uint32(0)
        for i in range(quarter):
            of_p = max(of_p, p[i] & _ALL_BUT_SIGN)
            of_q = max(of_q, q[i] & _ALL_BUT_SIGN)
            of_r = max(of_r, r[i] & _ALL_BUT_SIGN)
            of_s = max(of_s, s[i] & _ALL_BUT_SIGN)
        most = max(of_p, of_q, of_r, of_s)
        for i in range(4 * quarter, len(own)):
            most = max(most, own[i] & _ALL_BUT_SIGN)
        found[part] = most
        part = take(jobs, parts)
