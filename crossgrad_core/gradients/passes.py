"""Gramians of columns with gradients of any type and device, and their float64 rounding errors."""

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.gradients import generic, native
from crossgrad_core.gradients.columns import Column, is_native

#: A range of magnitudes. If float64 gradients are in this range, their squares and products neither
#: overflow nor underflow.
SAFE: Final = (1e-140, 1e140)


class Passes(Protocol):
    """The functions for single columns that both `native` and `generic` implement."""

    def overlap(self, column: Column, first: int, second: int) -> bool:
        """Return True if some element has a non-zero gradient in both views."""

    def row_gramians(self, columns: Sequence[Column], rows: int) -> NDArray[np.float64]:
        """Return [rows, K, K], the Gramian of each row."""

    def row_overlap(
        self, column: Column, first: int, second: int, rows: int, shared: NDArray[np.bool_]
    ) -> None:
        """Set `shared` to True for rows with an element that is non-zero in both views."""

    def row_combine(self, column: Column, weights: NDArray[np.float64], out: Tensor) -> None:
        """Write the weighted sum of each row, with weights [rows, K]."""


def passes_of(*columns: Column) -> Passes:
    """Return the compiled functions if all columns are supported, else the torch functions."""
    return native if all(map(is_native, columns)) else generic


def column_gramians(columns: Sequence[Column], views: int) -> NDArray[np.float64]:
    """Return [T, K, K] float64 Gramians.

    Entries of a view with a non-finite gradient are NaN or infinite.

    Products of float32 numbers are exact in float64. Products of float32 numbers can neither
    overflow nor underflow in float64. If float64 gradients have magnitudes outside `SAFE`, all
    gradients are first multiplied by a power of two.
    """
    gramians = np.zeros((len(columns), views, views))
    touched = [t for t, column in enumerate(columns) if any(g is not None for g in column)]
    compiled = [t for t in touched if is_native(columns[t])]
    others = [t for t in touched if not is_native(columns[t])]
    scale = _scale(columns)
    if compiled:
        gramians[compiled] = native.gramians([columns[t] for t in compiled])
        if scale != 1.0:
            gramians[compiled] *= scale**2
    if others:
        generic_gramians = torch.stack([generic.gramian(columns[t], scale) for t in others])
        gramians[others] = generic_gramians.cpu().numpy()
    return gramians


def column_remainders(
    columns: Sequence[Column], group: NDArray[np.int64], gramians: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return [B, K, K], the rounding residuals of `gramians`.

    Each of the given Gramians is a sum of results of `column_gramians`.

    Args:
        columns: T columns of gradients.
        group: [T] index of the Gramian to which each column was added; -1 for a column that was not
            added.
        gramians: [B, K, K] rounded Gramians.
    """
    return rounding_residuals(columns, group, gramians, _scale(columns))


def _scale(columns: Sequence[Column]) -> float:
    """Return a power of two that keeps products of float64 gradients in the range of float64."""
    touched = [column for column in columns if any(g is not None for g in column)]
    wide = [column for column in touched if _dtype(column) == torch.float64]
    if not wide:
        return 1.0
    sizes = torch.stack([generic.largest(column) for column in wide]).cpu().numpy()
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not sizes.size or (sizes.min() > SAFE[0] and sizes.max() < SAFE[1]):
        return 1.0
    return float(2.0 ** -np.frexp(sizes.max())[1])


def _dtype(column: Column) -> torch.dtype:
    return next(g.dtype for g in column if g is not None)


def rounding_residuals(
    columns: Sequence[Column],
    group: NDArray[np.int64],
    gramians: NDArray[np.float64],
    scale: float,
) -> NDArray[np.float64]:
    """Return [B, K, K]: the Gramians with about 106 bits, minus the rounded `gramians`.

    The result is NaN if a Gramian is not finite.

    Args:
        columns: T columns of gradients.
        group: [T] index of the Gramian to which each column was added; -1 for a column that was not
            added.
        gramians: [B, K, K] rounded Gramians.
        scale: Factor by which the gradients were multiplied.
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
    """Return [N, K, K], the rounding residuals of the Gramians of each row of a block."""
    from crossgrad_core.gradients.numba_kernels.rounding_residuals import (
        add_row_products,
        left_over,
    )

    high, low = np.zeros(gramians.shape), np.zeros(gramians.shape)
    for column in columns:
        if rows and any(gradient is not None for gradient in column):
            for piece, wide in generic.row_pieces(column, rows):
                add_row_products(wide.cpu().numpy(), high[piece], low[piece])
    return left_over(high, low, gramians)
