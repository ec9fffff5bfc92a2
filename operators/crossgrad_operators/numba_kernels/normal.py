"""Gramians as norms and cosines, which no ratio of norms can spoil."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_kernel

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

#: Two directions with 1 + cos up to this count as exactly opposite: what is left of them after a
#: projection is rounding noise, which a scale-free optimizer would follow.
OPPOSITE = 1e-12
#: A combination whose square is up to this share of that of its longest summand is zero. For two
#: opposite directions this is the same as `OPPOSITE`.
CANCELLED = 2.0 * OPPOSITE
#: |cos| up to which two directions have no product: sums that cancel round to about that.
UNRELATED = 1e-14
EPSILON = 2.220446049250313e-16
#: Errors of float64 algorithms on K rows, in units of K eps, generously.
CAUTION = 4.0


@strict_kernel
def normalised(gramian: Floats, present: Flags, norms: Floats, cosines: Floats) -> None:
    """Fills norms [K] and cosines [K, K] of one Gramian; zero for views that are not present."""
    views = present.size
    for k in range(views):
        norms[k] = np.sqrt(gramian[k, k]) if present[k] else 0.0
    for i in range(views):
        cosines[i, i] = 1.0 if present[i] else 0.0
        for j in range(i):
            c = 0.0
            if present[i] and present[j]:
                c = min(max(gramian[i, j] / norms[i] / norms[j], -1.0), 1.0)
            cosines[i, j] = c
            cosines[j, i] = c
