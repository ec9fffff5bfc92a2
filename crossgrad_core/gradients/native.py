"""Gramians and sums of float32 gradients on the CPU: one parallel kernel call for all tensors."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.gradients.columns import Column

#: Up to this number of elements, one thread is faster than several threads.
SMALL: Final = 1 << 17


def _addresses(columns: Sequence[Column]) -> NDArray[np.int64]:
    return np.array(
        [[0 if g is None or not g.numel() else g.data_ptr() for g in column] for column in columns],
        np.int64,
    )


def _sizes(columns: Sequence[Column]) -> NDArray[np.int64]:
    return np.array([max(_size(g) for g in column) for column in columns], np.int64)


def _run(sizes: NDArray[np.int64]) -> Callable[..., None]:
    from crossgrad_core.numerics.jobs import parallel, serial

    return parallel if int(sizes.sum()) > SMALL else serial


def _size(gradient: Tensor | None) -> int:
    return 0 if gradient is None else gradient.numel()


def gramians(columns: Sequence[Column]) -> NDArray[np.float64]:
    """Return [T, K, K], the Gramian of each column.

    Entries of a view with a non-finite gradient are NaN or infinite.
    """
    from crossgrad_core.gradients.numba_kernels import dense

    sizes = _sizes(columns)
    table = dense.chunk_table(sizes)
    views = len(columns[0])
    partial = np.zeros((len(table), views, views))
    _run(sizes)(dense.gramians, _addresses(columns), sizes, table, partial)
    return dense.summed(partial, table, len(sizes))


def spread_gramian(column: Column, rows: Tensor, count: int) -> NDArray[np.float64]:
    """Return the [K, K] Gramian of gradients that are zero except in `rows`.

    The result is bit-identical to the result for dense gradients with `count` rows.
    """
    from crossgrad_core.gradients.numba_kernels import dense
    from crossgrad_core.numerics.jobs import parallel

    width = max(_size(g) for g in column) // max(1, len(rows))
    chunks = -(-count * width // dense.CHUNK)
    partial = np.zeros((chunks, len(column), len(column)))
    addresses = _addresses([column])[0]
    parallel(dense.spread_gramian, addresses, rows.numpy(), width, count * width, partial)
    (gramian,) = dense.summed(partial, np.zeros((chunks, 1), np.int64), 1)
    return np.asarray(gramian)


def combine(
    columns: Sequence[Column],
    weights: NDArray[np.float64],
    plain: NDArray[np.bool_],
    out: Sequence[Tensor],
    divisor: float = 1.0,
) -> None:
    """Write the weighted sum of each column to `out`, in one pass over all gradients.

    Args:
        columns: T columns of gradients; None is left out.
        weights: [T, K] weight of each gradient.
        plain: [T], True for columns that are added without weights, in float32 and in the order of
            the views.
        out: T tensors for the results. Each output may be a gradient of its column.
        divisor: Number by which plain sums are divided, in float32.
    """
    from crossgrad_core.gradients.numba_kernels import dense

    sizes = np.array([result.numel() for result in out], np.int64)
    places = np.array([result.data_ptr() for result in out], np.int64)
    table = dense.chunk_table(sizes)
    addresses = _addresses(columns)
    _run(sizes)(dense.combine, addresses, weights, plain, float(divisor), places, sizes, table)


def overlap(column: Column, first: int, second: int) -> bool:
    """Return True if some element of a tensor has a non-zero gradient in both views."""
    from crossgrad_core.gradients.numba_kernels import dense

    a, b = column[first], column[second]
    if a is None or b is None or not a.numel():
        return False
    return bool(dense.overlapping(a.data_ptr(), b.data_ptr(), a.numel()))


def row_gramians(columns: Sequence[Column], rows: int) -> NDArray[np.float64]:
    """Return [N, K, K]: for each row, the Gramian over all tensors of a block."""
    from crossgrad_core.gradients.numba_kernels import rows as kernels
    from crossgrad_core.numerics.jobs import parallel

    sizes = _sizes(columns)
    out = np.zeros((rows, len(columns[0]), len(columns[0])))
    parallel(kernels.row_gramians, _addresses(columns), sizes // max(rows, 1), out)
    return out


def row_combine(column: Column, weights: NDArray[np.float64], out: Tensor) -> None:
    """Write the weighted sum of each row of a column to `out`, with `weights` [N, K]."""
    from crossgrad_core.gradients.numba_kernels import rows as kernels
    from crossgrad_core.numerics.jobs import parallel

    if out.numel():
        width = out.numel() // len(weights)
        addresses = _addresses([column])[0]
        weights = np.ascontiguousarray(weights)
        parallel(kernels.row_combine, addresses, weights, out.data_ptr(), width)


def row_overlap(
    column: Column, first: int, second: int, rows: int, shared: NDArray[np.bool_]
) -> None:
    """Set `shared` [N] to True for each row with an element that is non-zero in both views."""
    from crossgrad_core.gradients.numba_kernels import rows as kernels

    a, b = column[first], column[second]
    if a is not None and b is not None and a.numel():
        kernels.row_overlaps(a.data_ptr(), b.data_ptr(), rows, a.numel() // rows, shared)
