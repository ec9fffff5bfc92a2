"""What counts as rounding noise in norms and cosines, which no ratio of norms can spoil."""

import numpy as np
from numpy.typing import NDArray

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
