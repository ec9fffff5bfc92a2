"""Gradients that are zero in most rows, stored as sparse torch tensors of rows and values.

After `coalesced`, the rows are sorted and unique. Sums and products equal the results for dense
gradients, on all rows that occur in any of the sparse gradients.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from crossgrad_core.gradients.columns import Column, is_native


def sparse_rows(rows: Tensor, values: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a sparse gradient of shape `shape` that has `values` [R, ...] in `rows` [R] int64."""
    return torch.sparse_coo_tensor(rows[None], values, tuple(shape), check_invariants=False)


def rows_of(gradient: Tensor) -> Tensor:
    """Return the row numbers [R] int64 of a sparse gradient."""
    return gradient._indices()[0]  # noqa: SLF001 - the public function needs a flag that autograd drops


def values_of(gradient: Tensor) -> Tensor:
    """Return the values [R, ...] of a sparse gradient."""
    return gradient._values()  # noqa: SLF001 - see above


def coalesced(gradient: Tensor | None) -> Tensor | None:
    """Return the gradient. The rows of a sparse gradient become sorted and unique."""
    if gradient is None or not gradient.is_sparse:
        return gradient
    if gradient.sparse_dim() != 1:
        return gradient.to_dense()
    rows = rows_of(gradient)
    if not gradient.is_coalesced() and _rises(rows):
        # Mark the tensor as coalesced, so that torch does not sort its rows again.
        gradient._coalesced_(True)
    return gradient.coalesce()


def _rises(rows: Tensor) -> bool:
    """Return True if the numbers are strictly increasing."""
    if rows.is_cpu:  # NumPy has less overhead than torch for this comparison.
        numbers = rows.numpy()
        return bool((numbers[1:] > numbers[:-1]).all())
    return bool((rows[1:] > rows[:-1]).all())


def dense(gradient: Tensor | None) -> Tensor | None:
    """Return the gradient as a dense tensor."""
    if gradient is None or not gradient.is_sparse:
        return gradient
    full = values_of(gradient).new_zeros(gradient.shape)
    full[rows_of(gradient)] = values_of(gradient)
    return full


class PackedRows:
    """A column of gradients, stored on all rows that occur in any of its gradients.

    Attributes:
        column: The K gradients, with values for `rows` only. If any gradient is dense, all
            gradients are stored as dense tensors.
        rows: [R] int64 row numbers; None if the gradients are dense.
        shape: Shape of the complete tensor.
    """

    def __init__(self, column: Column) -> None:
        given = [g for g in column if g is not None]
        self.column: Column = column
        self.rows: Tensor | None = None
        self._tidy = all(g.is_sparse and g.is_coalesced() for g in given)
        self.shape = given[0].shape if given else torch.Size()
        if not any(g.is_sparse for g in given):
            return
        if not all(g.is_sparse and is_native([g]) for g in given):
            self.column = [dense(g) for g in column]
            return
        self.rows = _union([rows_of(g) for g in given], self.shape[0])
        self.column = [None if g is None else _on(g, self.rows) for g in column]

    def unpacked(self, result: Tensor | None) -> Tensor | None:
        """Return a result that was computed from the column, but for the complete tensor."""
        if result is None or self.rows is None:
            return result
        # Mark the tensor as coalesced, so that torch does not sort its rows again.
        return sparse_rows(self.rows, result, self.shape)._coalesced_(self._tidy)


def _union(rows: Sequence[Tensor], count: int) -> Tensor:
    """Return [R], all rows that occur in any of the lists. All row numbers are below `count`."""
    if len(rows) == 1:
        return rows[0]
    there = torch.zeros(count, dtype=torch.bool)
    for view_rows in rows:
        there[view_rows] = True
    return there.nonzero()[:, 0]


def _on(gradient: Tensor, rows: Tensor) -> Tensor:
    """Return [R, ...], the values of a gradient in `rows`.

    The list `rows` must include all rows of the gradient.
    """
    gradient_rows, values = rows_of(gradient), values_of(gradient)
    if len(gradient_rows) == len(rows):
        return values.contiguous()
    full = values.new_zeros((len(rows), *values.shape[1:]))
    full[torch.searchsorted(rows, gradient_rows)] = values
    return full
