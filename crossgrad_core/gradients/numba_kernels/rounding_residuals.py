"""Gramians with twice as many digits as float64, for operators that need more digits.

Products are added one at a time. The rounding errors of products and sums are added separately
(Ogita, Rump and Oishi 2005). The results are as exact as with 106-bit arithmetic. Sums of this kind
take ten times as long as plain sums.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.double_double import two_product, two_sum
from crossgrad_core.numerics.jit import strict_kernel

Floats = NDArray[np.float64]


@strict_kernel
def add_products(rows: Floats, high: Floats, low: Floats) -> None:
    """Add the Gramian of `rows` [K, P] to the upper triangle of `high` + `low`, both [K, K]."""
    views, size = rows.shape
    for i in range(views):
        for j in range(i, views):
            total, lost = high[i, j], low[i, j]
            for e in range(size):
                product, error = two_product(rows[i, e], rows[j, e])
                total, more = two_sum(total, product)
                lost += more + error
            high[i, j], low[i, j] = total, lost


@strict_kernel
def add_row_products(rows: Floats, high: Floats, low: Floats) -> None:
    """For each primitive, add the Gramian of `rows` [K, N, d] to `high` + `low`, both [N, K, K]."""
    for n in range(rows.shape[1]):
        add_products(rows[:, n], high[n], low[n])


@strict_kernel
def left_over(high: Floats, low: Floats, gramians: Floats) -> Floats:
    """Return [B, K, K]: high + low - gramians.

    Only the upper triangles of `high` and `low` are used.

    Both triangles of `gramians` are read, because matrix products may round the triangles
    differently.
    """
    result = np.zeros(gramians.shape)
    blocks, views, _ = gramians.shape
    for b in range(blocks):
        for i in range(views):
            for j in range(views):
                p, q = min(i, j), max(i, j)
                result[b, i, j] = (high[b, p, q] - gramians[b, i, j]) + low[b, p, q]
    return result
