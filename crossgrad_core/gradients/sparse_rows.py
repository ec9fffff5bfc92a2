"""Gradients that are zero in most rows, as torch's sparse tensors: rows and their values.

Rows are sorted and each is there once (`coalesced`). Sums and products of such gradients are those
of dense ones on the rows that any of them has.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from crossgrad_core.gradients.columns import Column, is_native


def sparse_rows(rows: Tensor, values: Tensor, shape: Sequence[int]) -> Tensor:
    """The sparse gradient of `shape` that has `values` [R, ...] in `rows` [R] int64."""
    return torch.sparse_coo_tensor(rows[None], values, tuple(shape), check_invariants=False)


def rows_of(gradient: Tensor) -> Tensor:
    """[R] int64 rows of a sparse gradient."""
    return gradient._indices()[0]  # noqa: SLF001 - the public name wants a flag that autograd drops


def values_of(gradient: Tensor) -> Tensor:
    """[R, ...] values of a sparse gradient."""
    return gradient._values()  # noqa: SLF001 - as above


def coalesced(gradient: Tensor | None) -> Tensor | None:
    """The gradient, its rows sorted and each there once if it is sparse."""
    if gradient is None or not gradient.is_sparse:
        return gradient
    if gradient.sparse_dim() != 1:
        return gradient.to_dense()
    rows = rows_of(gradient)
    if not gradient.is_coalesced() and _rises(rows):
        gradient._coalesced_(True)  # Torch's own mark, so that nobody looks again.
    return gradient.coalesce()


def _rises(rows: Tensor) -> bool:
    """Whether each number is larger than the one before."""
    if rows.is_cpu:  # NumPy begins sooner than torch.
        numbers = rows.numpy()
        return bool((numbers[1:] > numbers[:-1]).all())
    return bool((rows[1:] > rows[:-1]).all())


def dense(gradient: Tensor | None) -> Tensor | None:
    """The gradient with a value for each element."""
    if gradient is None or not gradient.is_sparse:
        return gradient
    full = values_of(gradient).new_zeros(gradient.shape)
    full[rows_of(gradient)] = values_of(gradient)
    return full


class PackedRows:
    """A column of gradients on the rows that any of them has.

    Attributes:
        column: K gradients of these rows; the gradients themselves where one of them is dense.
        rows: [R] int64; None where the gradients are dense.
        shape: Of the whole tensor.
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
        """A result of the column as a gradient of the whole tensor."""
        if result is None or self.rows is None:
            return result
        # Torch's own mark, so that nobody looks again.
        return sparse_rows(self.rows, result, self.shape)._coalesced_(self._tidy)


def _union(rows: Sequence[Tensor], count: int) -> Tensor:
    """[R] the rows of `count` that are in any of the lists."""
    if len(rows) == 1:
        return rows[0]
    there = torch.zeros(count, dtype=torch.bool)
    for each in rows:
        there[each] = True
    return there.nonzero()[:, 0]


def _on(gradient: Tensor, rows: Tensor) -> Tensor:
    """[R, ...] the values of a gradient in these rows, among which are all of its own."""
    own, values = rows_of(gradient), values_of(gradient)
    if len(own) == len(rows):
        return values.contiguous()
    full = values.new_zeros((len(rows), *values.shape[1:]))
    full[torch.searchsorted(rows, own)] = values
    return full
