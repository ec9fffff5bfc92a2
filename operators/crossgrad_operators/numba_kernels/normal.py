"""Limits for rounding noise in norms and cosines; the limits are valid for any ratio of norms."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

#: Two directions count as exactly opposite if 1 + cos is at most this value. A projection of such
#: directions would leave rounding noise, which a scale-free optimizer would follow.
OPPOSITE = 1e-12
#: A combination is zero if its square is at most this share of the square of its longest summand.
#: For two opposite directions this equals `OPPOSITE`.
CANCELLED = 2.0 * OPPOSITE
#: Two directions count as unrelated if |cos| is at most this value. Sums that cancel have an error
#: of this size.
UNRELATED = 1e-14
EPSILON = 2.220446049250313e-16
#: Error bound of float64 algorithms with K rows, in units of K eps. It includes a safety margin.
CAUTION = 4.0
