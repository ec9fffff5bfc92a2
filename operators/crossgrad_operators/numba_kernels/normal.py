"""Limits below which norms and cosines are rounding noise, valid for any ratio of norms."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

#: Two directions count as exactly opposite if 1 + cos is at most this value. Without this limit, a
#: projection would leave rounding noise, which Adam would scale to a full step.
OPPOSITE = 1e-12
#: A combination of gradients counts as zero if its squared length is at most this share of the
#: squared length of its longest summand. For two opposite directions, this limit corresponds to
#: `OPPOSITE`.
CANCELLED = 2.0 * OPPOSITE
#: Two directions count as orthogonal if |cos| is at most this value. The rounding error of a cosine
#: has about this size.
UNRELATED = 1e-14
EPSILON = 2.220446049250313e-16
#: Factor in the error bound of float64 algorithms with K rows; the unit is K eps. The factor
#: includes a safety margin.
CAUTION = 4.0
