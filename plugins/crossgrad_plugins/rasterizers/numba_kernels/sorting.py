"""Stable radix sort by depth."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel

#: Maximum number of bits that one pass of the sort uses. With more bits, the counters would not
#: leave space in the first-level cache.
_DIGIT = 11
#: Number of low bits of a float64 depth that are ignored. Depths that differ relatively by less
#: than 2e-10 then count as equal.
_DROPPED = 20


@device
def _width(number: int) -> int:
    """Return the number of bits of a non-negative number."""
    width = 0
    while number >> width:
        width += 1
    return width


@kernel
def order_by_depth(depths: NDArray[np.float64], items: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return `items` in ascending order of depth; items with equal depths keep their order.

    Args:
        depths: [M] positive camera depths of the items.
        items: [M] the items to sort.
    """
    count = items.shape[0]
    if count == 0:
        return items.copy()
    # Positive floating-point numbers have the order of their bit patterns. Subtract the smallest
    # bit pattern, because the difference needs few bits. The index of the item then fits into the
    # same integer, and the sort needs fewer passes.
    bits = depths.view(np.int64)
    least, most = bits[0] >> _DROPPED, bits[0] >> _DROPPED
    for i in range(count):
        least, most = min(least, bits[i] >> _DROPPED), max(most, bits[i] >> _DROPPED)
    of_key, of_place = _width(most - least), _width(count - 1)
    # This branch is needed only for about a million items whose depths differ by many orders of
    # magnitude.
    coarser = max(0, of_key + of_place - 63)
    of_key -= coarser
    # Use at least one pass, so that no division by zero passes occurs.
    passes = max(1, (of_key + _DIGIT - 1) // _DIGIT)
    of_digit = (of_key + passes - 1) // passes
    last_bin = (1 << of_digit) - 1
    # With unsigned indices, the compiled code does not test for negative values.
    bins = np.zeros((passes, last_bin + 1), np.uint32)
    packed, spare = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        key = ((bits[i] >> _DROPPED) - least) >> coarser
        packed[i] = (key << of_place) | i
        for digit in range(passes):
            bins[digit, (key >> (digit * of_digit)) & last_bin] += np.uint32(1)
    for digit in range(passes):
        digit_bins, shift = bins[digit], of_place + digit * of_digit
        position = np.uint32(0)
        for k in range(digit_bins.shape[0]):
            here = digit_bins[k]
            digit_bins[k] = position
            position = np.uint32(position + here)
        for i in range(count):
            entry = packed[i]
            k = (entry >> shift) & last_bin
            target = digit_bins[k]
            digit_bins[k] = np.uint32(target + np.uint32(1))
            spare[target] = entry
        packed, spare = spare, packed
    result = np.empty_like(items)
    for i in range(count):
        result[i] = items[packed[i] & ((1 << of_place) - 1)]
    return result
