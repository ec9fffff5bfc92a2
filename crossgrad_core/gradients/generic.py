"""Gramians and sums of gradients with torch, in float64, for any device and floating-point type."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.gradients.columns import Column

#: Number of elements of each gradient that are converted to float64 at a time. On the CPU, short
#: pieces keep the rounding errors of float64 sums small. On a GPU, long pieces are faster.
PIECE = {"cpu": 1 << 14, "cuda": 1 << 22}


def gramian(column: Column, scale: float = 1.0) -> Tensor:
    """Return the [K, K] float64 Gramian of `scale` times the gradients of a column."""
    first = _any(column)
    total = first.new_zeros((len(column), len(column)), dtype=torch.float64)
    partial = [wide @ wide.T for wide in pieces(column, scale)]
    return torch.stack(partial).sum(dim=0) if partial else total


def largest(column: Column) -> Tensor:
    """Return [K] float64, the largest magnitude of each gradient.

    For a missing or empty gradient, the result is 0.
    """
    first = _any(column)
    zero = first.new_zeros((), dtype=torch.float64)
    return torch.stack(
        [zero if g is None or not g.numel() else g.abs().max().double() for g in column]
    )


def combine(
    column: Column,
    weights: NDArray[np.float64],
    plain: bool,
    out: Tensor,
    divisor: float = 1.0,
) -> None:
    """Write the weighted sum of a column to `out`.

    The sum is computed in float64 in the given order, and rounded once.

    Args:
        column: The gradients of K views; None (a missing gradient) is left out.
        weights: [K] weight of each gradient.
        plain: True to add the gradients without weights, in their own type.
        out: Tensor for the result, which may be one of the gradients.
        divisor: Number by which a plain sum is divided.
    """
    used = [
        (w, g.reshape(-1)) for w, g in zip(weights.tolist(), column, strict=True) if g is not None
    ]
    flat = out.view(-1)
    step = PIECE.get(out.device.type, PIECE["cpu"])
    for start in range(0, flat.numel(), step):
        piece = slice(start, start + step)
        if plain:
            total = used[0][1][piece].clone()
            for _, g in used[1:]:
                total += g[piece]
            if divisor != 1.0:
                total /= divisor
        else:
            total = torch.zeros_like(flat[piece], dtype=torch.float64)
            for w, g in used:
                total += w * g[piece].double()
        flat[piece] = total


def overlap(column: Column, first: int, second: int) -> bool:
    """Return True if some element of a tensor has a non-zero gradient in both views."""
    a, b = column[first], column[second]
    return a is not None and b is not None and bool(((a != 0) & (b != 0)).any())


def row_gramians(columns: Sequence[Column], rows: int) -> NDArray[np.float64]:
    """Return [N, K, K]: for each row, the Gramian over all tensors of a block."""
    views = len(columns[0])
    total = np.zeros((rows, views, views))
    for column in columns:
        if not rows or all(g is None for g in column):
            continue
        for piece, wide in row_pieces(column, rows):
            total[piece] += torch.einsum("knd,lnd->nkl", wide, wide).cpu().numpy()
    return total


def row_combine(column: Column, weights: NDArray[np.float64], out: Tensor) -> None:
    """Write the weighted sum of each row of a column.

    A weight of 0 in `weights` [N, K] leaves out the row of a view.
    """
    rows = len(weights)
    total = torch.zeros_like(out, dtype=torch.float64).view(rows, -1)
    factors = torch.from_numpy(np.ascontiguousarray(weights.T)).to(out.device, non_blocking=True)
    for w, g in zip(factors, column, strict=True):
        if g is not None:
            wide = g.reshape(rows, -1).double()
            # Zero times infinity is NaN. Rows with weight zero are therefore replaced by zeros
            # instead of multiplied.
            total += torch.where(w[:, None] == 0, torch.zeros_like(wide), w[:, None] * wide)
    out.view(rows, -1).copy_(total)


def row_overlap(
    column: Column, first: int, second: int, rows: int, shared: NDArray[np.bool_]
) -> None:
    """Set `shared` [N] to True for each row with an element that is non-zero in both views."""
    a, b = column[first], column[second]
    if a is not None and b is not None and a.numel():
        both = ((a != 0) & (b != 0)).reshape(rows, -1).any(dim=1)
        shared |= both.cpu().numpy()


def _any(column: Column) -> Tensor:
    return next(g for g in column if g is not None)


def pieces(column: Column, scale: float) -> Iterator[Tensor]:
    """Yield [K, L] float64 pieces of the column's gradients, multiplied by `scale`."""
    first = _any(column)
    step = PIECE.get(first.device.type, PIECE["cpu"])
    absent = first.new_zeros((), dtype=torch.float64)
    for start in range(0, first.numel(), step):
        length = min(step, first.numel() - start)
        rows = [
            absent.expand(length)
            if g is None
            else g.reshape(-1)[start : start + length].double() * scale
            for g in column
        ]
        yield torch.stack(rows)


def row_pieces(column: Column, rows: int) -> Iterator[tuple[slice, Tensor]]:
    """Yield ranges of rows, each with the [K, n, d] float64 gradients of its n rows."""
    first = _any(column)
    width = max(first.numel() // rows, 1)
    step = max(PIECE.get(first.device.type, PIECE["cpu"]) // width, 1)
    flat = [(torch.zeros_like(first) if g is None else g).reshape(rows, -1) for g in column]
    for start in range(0, rows, step):
        piece = slice(start, start + step)
        yield piece, torch.stack([g[piece].double() for g in flat])
