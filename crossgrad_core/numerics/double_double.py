"""Arithmetic with pairs of float64 numbers: a number is the sum of a pair, with about 32 digits.

In a pair (high, low), |low| is at most half a unit in the last place of high. `two_sum` and
`two_product` are exact (Knuth 1969, Dekker 1971). Results for pairs have relative errors of a few
times 2^-104.
"""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_part

#: Factor 2^27 + 1, which splits a float64 number into two halves. Products of two halves are exact.
_SPLITTER = 134217729.0


@strict_device
def two_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum and its rounding error."""
    total = a + b
    b_in_total = total - a
    return total, (a - (total - b_in_total)) + (b - b_in_total)


@strict_device
def quick_two_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum and its rounding error. Requires |a| >= |b|."""
    total = a + b
    return total, b - (total - a)


@strict_device
def two_product(a: float, b: float) -> tuple[float, float]:
    """Return the rounded product and its rounding error. Magnitudes must be below 1e150."""
    product = a * b
    scaled = _SPLITTER * a
    a_high = scaled - (scaled - a)
    a_low = a - a_high
    scaled = _SPLITTER * b
    b_high = scaled - (scaled - b)
    b_low = b - b_high
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return product, error


@strict_device
def add(a: float, a_low: float, b: float, b_low: float) -> tuple[float, float]:
    """Return the sum of the pairs (a, a_low) and (b, b_low)."""
    high, low = two_sum(a, b)
    more, less = two_sum(a_low, b_low)
    high, low = quick_two_sum(high, low + more)
    return quick_two_sum(high, low + less)


@strict_device
def multiply(a: float, a_low: float, b: float, b_low: float) -> tuple[float, float]:
    """Return the product of the pairs (a, a_low) and (b, b_low)."""
    high, low = two_product(a, b)
    return quick_two_sum(high, low + (a * b_low + a_low * b))


@strict_part
def divide(a: float, a_low: float, b: float, b_low: float) -> tuple[float, float]:
    """Return the quotient of the pairs (a, a_low) and (b, b_low)."""
    first = a / b
    high, low = multiply(b, b_low, first, 0.0)
    rest, rest_low = add(a, a_low, -high, -low)
    second = rest / b
    high, low = multiply(b, b_low, second, 0.0)
    rest, _ = add(rest, rest_low, -high, -low)
    high, low = quick_two_sum(first, second)
    return add(high, low, rest / b, 0.0)


@strict_part
def square_root(a: float, a_low: float) -> tuple[float, float]:
    """Return the square root of the pair (a, a_low), which must not be negative."""
    if a <= 0.0:
        return 0.0, 0.0
    root = np.sqrt(a)
    high, low = two_product(root, root)
    rest, _ = add(a, a_low, -high, -low)
    return quick_two_sum(root, rest / (2.0 * root))
