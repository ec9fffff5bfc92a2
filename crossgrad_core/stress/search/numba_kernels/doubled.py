"""Pairs of float64 numbers as single values: formulas on top of `double_double`.

An array of such numbers has a last axis of two.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.jit import strict_part
from crossgrad_core.numba_kernels import double_double

Pair: TypeAlias = tuple[float, float]
Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]

_add, _multiply = double_double.add, double_double.multiply
_divide, _root = double_double.divide, double_double.square_root
two_product = double_double.two_product


@strict_part
def number(value: float) -> Pair:
    """A float64 number."""
    return value, 0.0


@strict_part
def at(array: Floats, i: int) -> Pair:
    """An entry of a vector [N, 2]."""
    return array[i, 0], array[i, 1]


@strict_part
def entry(matrix: Floats, i: int, j: int) -> Pair:
    """An entry of a matrix [M, N, 2]."""
    return matrix[i, j, 0], matrix[i, j, 1]


@strict_part
def add(a: Pair, b: Pair) -> Pair:
    """A sum."""
    return _add(a[0], a[1], b[0], b[1])


@strict_part
def minus(a: Pair) -> Pair:
    """The opposite."""
    return -a[0], -a[1]


@strict_part
def multiply(a: Pair, b: Pair) -> Pair:
    """A product."""
    return _multiply(a[0], a[1], b[0], b[1])


@strict_part
def divide(a: Pair, b: Pair) -> Pair:
    """A quotient."""
    return _divide(a[0], a[1], b[0], b[1])


@strict_part
def root(a: Pair) -> Pair:
    """A square root; zero for what is not positive."""
    return _root(a[0], a[1])
