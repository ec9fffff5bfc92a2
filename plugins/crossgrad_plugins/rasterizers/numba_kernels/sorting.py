"""Stable radix sort by depth."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel

#: Bits of a digit, at most: more would not leave the first-level cache to what is sorted.
_DIGIT = 11
#: Low bits of the float64 that are dropped: depths that agree to 2e-10 count as equal.
_DROPPED = 20


@device
def _width(number: int) -> int:
    """Returns the bits of a number that is not negative."""
    width = 0
    while number >> width:
        width += 1
    return width


@kernel
def order_by_depth(depths: NDArray[np.float64], items: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns `items` by rising depth; equal depths keep their order.

    Args:
        depths: [M] positive camera depths of the items.
        items: [M] whatever is to be ordered.
    """
    count = items.shape[0]
    if count == 0:
        return items.copy()
    # Positive floating-point numbers order like their bit patterns. Counted from the least one they
    # are short, so that the place of an item fits beside its key and a digit or two less is sorted.
    bits = depths.view(np.int64)
    least, most = bits[0] >> _DROPPED, bits[0] >> _DROPPED
    for i in range(count):
        least, most = min(least, bits[i] >> _DROPPED), max(most, bits[i] >> _DROPPED)
    of_key, of_place = _width(most - least), _width(count - 1)
    # Of a million items whose depths have all orders of magnitude that there are.
    coarser = max(0, of_key + of_place - 63)
    of_key -= coarser
    # One at least: a number of bits must not be negative.
    passes = max(1, (of_key + _DIGIT - 1) // _DIGIT)
    of_digit = (of_key + passes - 1) // passes
    last_bin = (1 << of_digit) - 1
    # Indices that cannot be negative are not looked at.
    bins = np.zeros((passes, last_bin + 1), np.uint32)
    packed, spare = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        key = ((bits[i] >> _DROPPED) - least) >> coarser
        packed[i] = (key << of_place) | i
        for digit in range(passes):
            bins[digit, (key >> (digit * of_digit)) & last_bin] += np.uint32(1)
    for digit in range(passes):
        own, shift = bins[digit], of_place + digit * of_digit
        position = np.uint32(0)
        for k in range(own.shape[0]):
            here = own[k]
            own[k] = position
            position = np.uint32(position + here)
        for i in range(count):
            each = packed[i]
            k = (each >> shift) & last_bin
            target = own[k]
            own[k] = np.uint32(target + np.uint32(1))
            spare[target] = each
        packed, spare = spare, packed
    result = np.empty_like(items)
    for i in range(count):
        result[i] = items[packed[i] & ((1 << of_place) - 1)]
    return result
