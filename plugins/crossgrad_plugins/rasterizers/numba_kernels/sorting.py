"""Stable radix sort by depth."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.jit import kernel

_DIGIT = 11  # bits
_BINS = 1 << _DIGIT
_PASSES = 4
# Dropped low bits of the float64: depths that agree to 2e-10 count as equal.
_DROPPED = 64 - _DIGIT * _PASSES


@kernel
def order_by_depth(depths: NDArray[np.float64], items: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns `items` by rising depth; equal depths keep their order.

    Args:
        depths: [M] positive camera depths of the items.
        items: [M] whatever is to be ordered.
    """
    count = items.shape[0]
    # Positive floating-point numbers order like their bit patterns.
    keys = depths.view(np.uint64) >> np.uint64(_DROPPED)
    spare_keys = np.empty_like(keys)
    result = items.copy()
    spare = np.empty_like(result)
    bins = np.zeros((_PASSES, _BINS), np.int32)
    last_bin = np.uint64(_BINS - 1)
    for i in range(count):
        for digit in range(_PASSES):
            bins[digit, np.intp((keys[i] >> np.uint64(digit * _DIGIT)) & last_bin)] += 1
    for digit in range(_PASSES):
        shift = np.uint64(digit * _DIGIT)
        if count == 0 or bins[digit, np.intp((keys[0] >> shift) & last_bin)] == count:
            continue  # this digit is the same everywhere
        position = 0
        for k in range(_BINS):
            here = bins[digit, k]
            bins[digit, k] = position
            position += here
        for i in range(count):
            k = np.intp((keys[i] >> shift) & last_bin)
            target = bins[digit, k]
            bins[digit, k] = target + 1
            spare_keys[target] = keys[i]
            spare[target] = result[i]
        keys, spare_keys = spare_keys, keys
        result, spare = spare, result
    return result
