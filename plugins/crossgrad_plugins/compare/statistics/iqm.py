"""The interquartile mean."""

import numpy as np
from numpy.typing import NDArray


def iqm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of the middle half along the last axis.

    A value that lies on the border of the middle half counts with the share that is inside, so
    that the weights are the same for any number of values: two values give their mean, three give
    the middle one a weight of 2/3.

    Args:
        values: [..., n] numbers, n >= 1.

    Returns:
        [...] means.
    """
    count = values.shape[-1]
    first = np.arange(count, dtype=np.float64)
    weights = np.minimum(first + 1.0, 0.75 * count) - np.maximum(first, 0.25 * count)
    weights = np.clip(weights, 0.0, None)
    means: NDArray[np.float64] = np.sort(values, axis=-1) @ (weights / weights.sum())
    return means
