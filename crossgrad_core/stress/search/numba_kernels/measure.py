"""How far float64 results are from weighted sums in 32 digits."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.jit import strict_kernel
from crossgrad_core.stress.search.numba_kernels.doubled import (
    Flags,
    Floats,
    add,
    at,
    divide,
    entry,
    minus,
    multiply,
    number,
)
from crossgrad_core.stress.search.numba_kernels.linear import directions


@strict_kernel
def measured(rows: Floats, weights: Floats, found: Floats) -> NDArray[np.float64]:
    """[B, 3] |found - u|, |u| and max |w_k| |g_k| for u = sum w_k g_k.

    Args:
        rows: [B, K, P].
        weights: [B, K, 2].
        found: [B, P].
    """
    blocks, views, size = rows.shape
    result = np.zeros((blocks, 3))
    for b in range(blocks):
        apart, square = 0.0, 0.0
        for p in range(size):
            total = (0.0, 0.0)
            for k in range(views):
                total = add(total, multiply(at(weights[b], k), number(rows[b, k, p])))
            square += total[0] * total[0]
            gap = add(total, minus(number(found[b, p])))[0]
            apart += gap * gap
        for k in range(views):
            length = 0.0
            for p in range(size):
                length += rows[b, k, p] * rows[b, k, p]
            result[b, 2] = max(result[b, 2], abs(weights[b, k, 0]) * np.sqrt(length))
        result[b, 0], result[b, 1] = np.sqrt(apart), np.sqrt(square)
    return result


@strict_kernel
def directions_of(rows: Floats, present: Flags) -> tuple[Floats, Floats]:
    """Norms [B, K, 2] and cosines [B, K, K, 2] of rows [B, K, P]."""
    blocks, views, _ = rows.shape
    norms, cosines = np.empty((blocks, views, 2)), np.empty((blocks, views, views, 2))
    for b in range(blocks):
        directions(rows[b], present[b], norms[b], cosines[b])
    return norms, cosines


@strict_kernel
def pivots_of(cosines_of: Floats) -> NDArray[np.float64]:
    """[B, K] pivots of the Cholesky factors of cosines [B, K, K, 2], the largest first."""
    blocks, views = cosines_of.shape[:2]
    result = np.zeros((blocks, views))
    for b in range(blocks):
        left = cosines_of[b].copy()
        for turn in range(views):
            p = 0
            for k in range(views):
                if left[k, k, 0] > left[p, p, 0]:
                    p = k
            pivot = entry(left, p, p)
            if pivot[0] <= 0.0:
                break
            result[b, turn] = pivot[0]
            column = left[p].copy()
            for i in range(views):
                share = divide(at(column, i), pivot)
                for j in range(views):
                    rest = add(entry(left, i, j), minus(multiply(share, at(column, j))))
                    left[i, j, 0], left[i, j, 1] = rest
            left[p, :] = 0.0
            left[:, p] = 0.0
    return result
