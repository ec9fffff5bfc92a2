"""What operators share that give each gradient one weight."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.operator import OperatorContext

Floats = NDArray[np.float64]


def weighting(weights: Floats) -> Floats:
    """[B, K, K] matrices that multiply each of K gradients by its weight; `weights` is [B, K]."""
    blocks, views = weights.shape
    matrices = np.zeros((blocks, views, views))
    matrices.reshape(blocks, -1)[:, :: views + 1] = weights
    return matrices


def sharpened(
    weights: Floats,
    doubtful: NDArray[np.bool_],
    gramians: Floats,
    context: OperatorContext,
    exact: Callable[[Floats, Floats, NDArray[np.bool_]], Floats],
) -> Floats:
    """Weights of which the doubtful ones are worked out anew, with twice the digits.

    Args:
        weights: [B, K] or rows [B, K, K], changed in place.
        doubtful: [B].
        gramians: [B, K, K].
        context: Tells which views are present, and what rounding took from the Gramians; where
            nobody knows that, the weights stay as they are.
        exact: From the doubtful Gramians, their remainders and presence [n, K] to their weights.

    Returns:
        `weights`.
    """
    if context.remainders is not None and doubtful.any():
        part = np.flatnonzero(doubtful)
        weights[part] = exact(gramians[part], context.remainders()[part], context.present[part])
    return weights
