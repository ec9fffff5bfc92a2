"""Passes over gradients with torch: any device and floating-point type, in float64 pieces."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.gradients.columns import Column

#: Number of elements of K gradients that are converted to float64 at a time. Short pieces on the
#: CPU keep the rounding errors of long float64 sums small. Long pieces are faster on a GPU.
PIECE = {"cpu": 1 << 14, "cuda": 1 << 22}


def gramian(column: Column, scale: float = 1.0) -> Tensor:
    """Return the [K, K] float64 Gramian of `scale` times a column's gradients, on their device."""
    first = _any(column)
    total = first.new_zeros((len(column), len(column)), dtype=torch.float64)
    partial = [wide @ wide.T for wide in pieces(column, scale)]
    return torch.stack(partial).sum(dim=0) if partial else total


def largest(column: Column) -> Tensor:
    """Return [K] float64, the largest magnitude of each gradient; 0 if absent or empty."""
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
    """Write the weighted sum of a column, in float64 and rounded once, in the given order.

    Args:
        column: K gradients; None is left out.
        weights: [K].
        plain: True to add without weights, in the type of the gradients.
        out: The result; may be one of the gradients.
        divisor: Divisor of a plain sum.
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
    """Return True if two views' gradients of a tensor have a common non-zero element."""
    a, b = column[first], column[second]
    return a is not None and b is not None and bool(((a != 0) & (b != 0)).any())


def row_gramians(columns: Sequence[Column], rows: int) -> NDArray[np.float64]:
    """Return [N, K, K], the Gramians of the rows of a block's tensors."""
    views = len(columns[0])
    total = np.zeros((rows, views, views))
    for column in columns:
        if not rows or all(g is None for g in column):
            continue
        for piece, wide in row_pieces(column, rows):
            total[piece] += torch.einsum("knd,lnd->nkl", wide, wide).cpu().numpy()
    return total


def row_combine(column: Column, weights: NDArray[np.float64], out: Tensor) -> None:
    """Write the row-wise weighted sum of a column; in `weights` [N, K], 0 leaves out a row."""
    rows = len(weights)
    total = torch.zeros_like(out, dtype=torch.float64).view(rows, -1)
    factors = torch.from_numpy(np.ascontiguousarray(weights.T)).to(out.device, non_blocking=True)
    for w, g in zip(factors, column, strict=True):
        if g is not None:
            wide = g.reshape(rows, -1).double()
            # Zero times infinity is NaN, so rows of weight zero are selected instead of multiplied.
            total += torch.where(w[:, None] == 0, torch.zeros_like(wide), w[:, None] * wide)
    out.view(rows, -1).copy_(total)


def row_overlap(
    column: Column, first: int, second: int, rows: int, shared: NDArray[np.bool_]
) -> None:
    """Set `shared` [N] for rows in which two views have a common non-zero element."""
    a, b = column[first], column[second]
    if a is not None and b is not None and a.numel():
        both = ((a != 0) & (b != 0)).reshape(rows, -1).any(dim=1)
        shared |= both.cpu().numpy()


def _any(column: Column) -> Tensor:
    return next(g for g in column if g is not None)


def pieces(column: Column, scale: float) -> Iterator[Tensor]:
    """Yield [K, L] float64 pieces of the column's gradients, times `scale`."""
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
    """Yield row ranges with the [K, n, d] float64 gradients of their rows."""
    first = _any(column)
    width = max(first.numel() // rows, 1)
    step = max(PIECE.get(first.device.type, PIECE["cpu"]) // width, 1)
    flat = [(torch.zeros_like(first) if g is None else g).reshape(rows, -1) for g in column]
    for start in range(0, rows, step):
        piece = slice(start, start + step)
        yield piece, torch.stack([g[piece].double() for g in flat])
