"""Codebooks of numbers and palettes of rows, by k-means (Lloyd's algorithm)."""

from math import ceil, sqrt
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: Number of entries of a codebook, and the largest number of entries of a palette.
ENTRIES, LARGEST = 256, 65_536
#: Number of rows per palette entry.
_ROWS_PER_ENTRY: Final = 4
#: Rounds for a palette and for a codebook. A palette of 8 rounds is 1 % better than one of 3.
_ROUNDS, _BOOK_ROUNDS, _SAMPLE = 4, 8, 100_000
#: Entries of a distance matrix that are in memory at the same time.
_AT_ONCE: Final = 1 << 22


def codebook_of(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return [256] increasing numbers that approximate `values`, including their extremes."""
    numbers = np.sort(values, axis=None).astype(np.float64)
    low, high = numbers[0], numbers[-1]
    numbers = numbers[:: ceil(len(numbers) / _SAMPLE)]
    # Quantiles alone would leave too few entries for rare values.
    half = ENTRIES // 2
    book = np.sort(
        np.concatenate([np.linspace(low, high, half), np.quantile(numbers, np.arange(half) / half)])
    )
    sums = np.concatenate([[0.0], np.cumsum(numbers)])
    for _ in range(_BOOK_ROUNDS):
        ends = np.searchsorted(numbers, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(numbers)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), book)
    book[0], book[-1] = low, high
    return np.sort(book.astype(np.float32)).astype(np.float64)


def nearest_entry(values: NDArray[np.float32], book: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the position of the nearest number of `book`, in the shape of `values`."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def palette_of(
    rows: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return a palette [K, D] of rows, and the entry of each row [N].

    A palette of thousands of entries is made in two levels: the rows are divided into groups, and
    each group gets entries by its share of the squared errors.
    """
    given = torch.from_numpy(np.ascontiguousarray(rows))
    size = min(LARGEST, max(1, len(rows) // _ROWS_PER_ENTRY))
    groups = max(1, int(sqrt(size)))
    coarse = _lloyd(given[:: ceil(len(given) / _SAMPLE)], groups)
    labels = _nearest(given, coarse)
    errors = torch.zeros(groups).index_add_(0, labels, (given - coarse[labels]).square().sum(1))
    shares = errors / errors.sum().clamp(min=1e-30)
    order = labels.argsort(stable=True)
    palette, entry = [], torch.empty(len(given), dtype=torch.int64)
    first = 0
    parts = torch.split(order, labels.bincount(minlength=groups).tolist())
    for members, share in zip(parts, shares.tolist(), strict=True):
        if not len(members):
            continue
        inside = given[members]
        fine = _lloyd(inside, min(len(members), 1 + int(share * (size - groups))))
        entry[members] = first + _nearest(inside, fine)
        palette.append(fine)
        first += len(fine)
    return torch.cat(palette).numpy(), entry.numpy()


def _lloyd(rows: Tensor, count: int) -> Tensor:
    """Return [K, D] at most `count` centroids of `rows` [N, D]."""
    centroids = rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).long()]
    for _ in range(_ROUNDS if len(centroids) < len(rows) else 0):
        labels = _nearest(rows, centroids)
        sums = torch.zeros_like(centroids).index_add_(0, labels, rows)
        counts = labels.bincount(minlength=len(centroids))[:, None]
        centroids = torch.where(counts > 0, sums / counts.clamp(min=1), centroids)
    return centroids


def _nearest(rows: Tensor, centroids: Tensor) -> Tensor:
    """Return [N] the position of the nearest centroid of each row."""
    lengths = centroids.square().sum(1) / 2
    parts = torch.split(rows, max(1, _AT_ONCE // len(centroids)))
    return torch.cat([(lengths - part @ centroids.T).argmin(1) for part in parts])
