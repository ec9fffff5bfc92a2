"""Convert Gramians to norms and cosines with 16 or 32 digits, and detect opposite directions."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_device, strict_part
from crossgrad_operators.numba_kernels.digits import (
    Exact,
    Pair,
    Pairs,
    at,
    clear,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)
from crossgrad_operators.numba_kernels.normal import CANCELLED
from crossgrad_operators.numba_kernels.polyhedron import Polyhedron, share_left, square

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
#: The weights, and True for each block whose weights may change if more digits are used.
Solved = tuple[Floats, Flags]


@strict_part
def directions(
    gramian: Floats, remainder: Floats, present: Flags, norms: Pairs, cosines: Pairs, exact: Exact
) -> int:
    """Write the norms [K] and the cosines [K, K] of the gradients.

    The norms and cosines of views without a gradient are zero.

    Args:
        gramian: [K, K] Gramian.
        remainder: [K, K] rounding residuals of the Gramian; unused with 16 digits.
        present: [K] True for views that have a gradient.
        norms: [K] output.
        cosines: [K, K] output.
        exact: True for 32 digits, None for 16 digits.

    Returns:
        The number of views that have a gradient.
    """
    count = 0
    clear(norms)
    for k in range(present.size):
        clear(cosines[k])
        if present[k]:
            put(norms, k, root((gramian[k, k], remainder[k, k]), exact))
            count += 1
    for i in range(present.size):
        if present[i]:
            cosines[i, i, 0] = 1.0
        for j in range(i):
            if present[i] and present[j]:
                cosine = quotient((gramian[i, j], remainder[i, j]), at(norms, i), exact)
                put(cosines[i], j, limited(quotient(cosine, at(norms, j), exact)))
                put(cosines[j], i, at(cosines[i], j))
    return count


@strict_device
def limited(cosine: Pair) -> Pair:
    """Return a cosine clipped to [-1, 1]."""
    if cosine[0] > 1.0:
        return 1.0, 0.0
    if cosine[0] < -1.0:
        return -1.0, 0.0
    return cosine


@strict_device
def form(v: Pairs, cosines: Pairs, exact: Exact) -> Pair:
    """Return the squared length of the sum of v_k times the k-th unit gradient."""
    total = 0.0, 0.0
    for i in range(len(v)):
        if v[i, 0] != 0.0:
            inner = products(cosines[i], v, 0, len(v), exact)
            total = plus(total, product(at(v, i), inner, exact), exact)
    return total


@strict_device
def cancels(v: Pairs, cosines: Pairs, exact: Exact) -> bool:
    """Return True if the sum of v_k times the k-th unit gradient is only rounding noise."""
    longest = np.abs(v[:, 0]).max()
    return form(v, cosines, exact)[0] <= CANCELLED * longest * longest


@strict_device
def present_in(problem: Polyhedron) -> int:
    """Return the number of views that have a gradient."""
    count = 0
    for k in range(problem.active.size):
        if problem.cosines[k, k, 0] > 0.0:
            count += 1
    return count


@strict_device
def what_is_left(problem: Polyhedron, x: Pairs) -> float:
    """Return a factor for the coefficients x.

    The factor is 0 if only rounding noise of opposite directions remains.

    Two directions are opposite if 1 + cos is at most 1e-12. `share_left` contains the rule for more
    than two directions.
    """
    if present_in(problem) > 2:
        return share_left(problem, x)
    largest = 0.0
    for k in range(len(x)):
        largest = max(largest, abs(x[k, 0]))
    return 0.0 if square(problem, x)[0] <= CANCELLED * largest * largest else 1.0
