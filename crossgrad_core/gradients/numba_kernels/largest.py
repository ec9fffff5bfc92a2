"""The largest magnitude in each array, returned as its bits (Numba, CPU, float32)."""

import numpy as np
from numba import carray
from numpy.typing import NDArray

from crossgrad_core.gradients.numba_kernels.pointers import float32_pointer
from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

#: Number of elements in one job of the work queue.
PART = 2**15
_ALL_BUT_SIGN = np.uint32(0x7FFFFFFF)


@kernel
def largest_bits(
    jobs: Jobs,
    addresses: NDArray[np.int64],
    sizes: NDArray[np.int64],
    starts: NDArray[np.int64],
    found: NDArray[np.uint32],
) -> None:
    """Write the bits of the largest magnitude in each part of several float32 arrays.

    If the sign bit is ignored, larger magnitudes have larger bits; infinity and NaN have the
    largest bits.

    Args:
        jobs: Job counters, passed by `parallel`.
        addresses: [T] addresses of float32 arrays.
        sizes: [T] number of elements of each array.
        starts: [T + 1] number of the first part of each array. A part contains `PART` elements. The
            last part of an array may be shorter.
        found: Output: the largest bits in each part.
    """
    parts = len(found)
    part = next_job(jobs, parts)
    while part < parts:
        tensor = 0
        while part >= starts[tensor + 1]:
            tensor += 1
        size, first = sizes[tensor], (part - starts[tensor]) * PART
        bits = carray(float32_pointer(addresses[tensor]), size).view(np.uint32)
        part_bits = bits[first : min(size, first + PART)]
        # Read from four positions at a time. With four positions at a time, the processor waits
        # less for memory than with one position.
        quarter = len(part_bits) // 4
        p, q = part_bits[:quarter], part_bits[quarter : 2 * quarter]
        r, s = part_bits[2 * quarter : 3 * quarter], part_bits[3 * quarter : 4 * quarter]
        of_p = of_q = of_r = of_s = np.uint32(0)
        for i in range(quarter):
            of_p = max(of_p, p[i] & _ALL_BUT_SIGN)
            of_q = max(of_q, q[i] & _ALL_BUT_SIGN)
            of_r = max(of_r, r[i] & _ALL_BUT_SIGN)
            of_s = max(of_s, s[i] & _ALL_BUT_SIGN)
        most = max(of_p, of_q, of_r, of_s)
        for i in range(4 * quarter, len(part_bits)):
            most = max(most, part_bits[i] & _ALL_BUT_SIGN)
        found[part] = most
        part = next_job(jobs, parts)
