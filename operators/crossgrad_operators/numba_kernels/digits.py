"""Arithmetic with one or two float64 numbers, so that algorithms can use 16 or 32 digits.

A number is a pair (high, low) of float64 numbers. `exact` is True for 32 digits and None for 16
digits. With 16 digits, the low part is always 0. None and True have different types in Numba. Numba
therefore compiles a separate kernel for each of the two values.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.double_double import (
    add,
    divide,
    multiply,
    quick_two_sum,
    square_root,
    two_product,
    two_sum,
)
from crossgrad_core.numerics.jit import strict_device, strict_part

Pair = tuple[float, float]
Exact = Literal[True] | None
#: Arrays [n, 2] or [n, n, 2]. The last dimension contains the high and the low part of each number.
Pairs = NDArray[np.float64]
ONE: Final = (1.0, 0.0)


@strict_device
def plus(a: Pair, b: Pair, exact: Exact) -> Pair:
    """Return a + b."""
    if exact is None:
        return a[0] + b[0], 0.0
    return add(a[0], a[1], b[0], b[1])


@strict_device
def minus(a: Pair, b: Pair, exact: Exact) -> Pair:
    """Return a - b."""
    if exact is None:
        return a[0] - b[0], 0.0
    return add(a[0], a[1], -b[0], -b[1])


@strict_device
def product(a: Pair, b: Pair, exact: Exact) -> Pair:
    """Return a times b."""
    if exact is None:
        return a[0] * b[0], 0.0
    return multiply(a[0], a[1], b[0], b[1])


@strict_device
def quotient(a: Pair, b: Pair, exact: Exact) -> Pair:
    """Return a divided by b."""
    if exact is None:
        return a[0] / b[0], 0.0
    return divide(a[0], a[1], b[0], b[1])


@strict_device
def root(a: Pair, exact: Exact) -> Pair:
    """Return the square root of a, or 0 if a is negative."""
    if exact is None:
        return np.sqrt(max(a[0], 0.0)), 0.0
    return square_root(a[0], a[1])


@strict_part
def products(a: Pairs, b: Pairs, first: int, last: int, exact: Exact) -> Pair:
    """Return the sum of a_i b_i for i from `first` to `last` - 1."""
    high = low = 0.0
    if exact is None:
        for i in range(first, last):
            high += a[i, 0] * b[i, 0]
        return high, 0.0
    for i in range(first, last):
        one, lost = two_product(a[i, 0], b[i, 0])
        high, more = two_sum(high, one)
        low += more + (lost + (a[i, 0] * b[i, 1] + a[i, 1] * b[i, 0]))
    return quick_two_sum(high, low)


@strict_device
def at(values: Pairs, k: int) -> Pair:
    """Return the number at index k."""
    return values[k, 0], values[k, 1]


@strict_device
def put(values: Pairs, k: int, value: Pair) -> None:
    """Write a number at index k."""
    values[k, 0], values[k, 1] = value


@strict_device
def clear(values: Pairs) -> None:
    """Set all numbers to zero."""
    for k in range(len(values)):
        values[k, 0], values[k, 1] = 0.0, 0.0


@strict_device
def copy(values: Pairs, to: Pairs) -> None:
    """Copy all numbers."""
    for k in range(len(values)):
        to[k, 0], to[k, 1] = values[k, 0], values[k, 1]


@strict_device
def longest_of(norms: Pairs) -> tuple[Pair, float]:
    """Return the largest of non-negative numbers, and how many of the numbers are above zero."""
    longest, count = 0, 0.0
    for k in range(len(norms)):
        if norms[k, 0] > norms[longest, 0]:
            longest = k
        if norms[k, 0] > 0.0:
            count += 1.0
    return at(norms, longest), count
