"""Stable radix sort by depth."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.jit import kernel

_DIGIT = 11  # bits
_BINS = 1 << _DIGIT
_PASSES = 6  # of 64 bits


@kernel
def order_by_depth(depths: NDArray[np.float64], items: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns `items` by rising depth; equal depths keep their order.

    Args:
        depths: [M] positive, finite camera depths of the items.
        items: [M] whatever is to be ordered.
    """
    count = items.shape[0]
    # Positive floating-point numbers order like their bit patterns.
    keys = depths.view(np.uint64).copy()
    spare_keys = np.empty_like(keys)
    result = items.copy()
    spare = np.empty_like(result)
    histogram = np.zeros((_PASSES, _BINS), np.int32)
    for i in range(count):
        for digit in range(_PASSES):
            bin_ = np.intp((keys[i] >> np.uint64(digit * _DIGIT)) & np.uint64(_BINS - 1))
            histogram[digit, bin_] += 1
    for digit in range(_PASSES):
        shift = np.uint64(digit * _DIGIT)
        if count == 0 or histogram[digit, np.intp((keys[0] >> shift) & np.uint64(_BINS - 1))] == count:
            continue
        position = 0
        for bin_ in range(_BINS):
            here = histogram[digit, bin_]
            histogram[digit, bin_] = position
            position += here
        for i in range(count):
            bin_ = np.intp((keys[i] >> shift) & np.uint64(_BINS - 1))
            target = histogram[digit, bin_]
            histogram[digit, bin_] = target + 1
            spare_keys[target] = keys[i]
            spare[target] = result[i]
        keys, spare_keys = spare_keys, keys
        result, spare = spare, result
    return result
