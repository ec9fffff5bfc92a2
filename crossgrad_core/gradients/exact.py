"""Rounding errors of Gramians in float64: a slow second pass over gradients of any type."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.gradients import generic
from crossgrad_core.gradients.columns import Column


def rounding_residuals(
    columns: Sequence[Column],
    group: NDArray[np.int64],
    gramians: NDArray[np.float64],
    scale: float,
) -> NDArray[np.float64]:
    """[B, K, K] what is missing from Gramians, to about 106 bits; NaN where one is not finite.

    Args:
        columns: T columns.
        group: [T] Gramian that each column is part of; -1 leaves it out.
        gramians: [B, K, K] as they were rounded.
        scale: What the gradients were multiplied by for them.
    """
    from crossgrad_core.gradients.numba_kernels.rounding_residuals import add_products, left_over

    high, low = np.zeros(gramians.shape), np.zeros(gramians.shape)
    for b, column in zip(group.tolist(), columns, strict=True):
        if b >= 0 and any(gradient is not None for gradient in column):
            for piece in generic.pieces(column, scale):
                add_products(piece.cpu().numpy(), high[b], low[b])
    return left_over(high, low, gramians)


def row_remainders(
    columns: Sequence[Column], rows: int, gramians: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N, K, K] the same for the Gramians of the rows of a block's tensors."""
    from crossgrad_core.gradients.numba_kernels.rounding_residuals import (
        add_row_products,
        left_over,
    )

    high, low = np.zeros(gramians.shape), np.zeros(gramians.shape)
    for column in columns:
        if rows and any(gradient is not None for gradient in column):
            for part, wide in generic.row_pieces(column, rows):
                add_row_products(wide.cpu().numpy(), high[part], low[part])
    return left_over(high, low, gramians)
