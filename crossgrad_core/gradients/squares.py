"""Gramians of any mixture of columns, each by the pass that takes it."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.gradients import exact, generic, native
from crossgrad_core.gradients.columns import Column, is_native

#: Largest magnitudes of float64 gradients whose squares and products stay well inside float64.
SAFE: Final = (1e-140, 1e140)


def column_gramians(columns: Sequence[Column], views: int) -> NDArray[np.float64]:
    """[T, K, K] float64 Gramians; NaN or infinite in rows of views that are not finite.

    float32 products are exact in float64 and can neither overflow nor vanish there. Where float64
    gradients have magnitudes outside `SAFE`, all Gramians are those of the gradients times one
    power of two.
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
        found = torch.stack([generic.gramian(columns[t], scale) for t in others])
        gramians[others] = found.cpu().numpy()
    return gramians


def column_remainders(
    columns: Sequence[Column], group: NDArray[np.int64], gramians: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[B, K, K] what rounding took from the sums `gramians` of `column_gramians`.

    Args:
        columns: T columns.
        group: [T] which of the sums each column is part of; -1 for none.
        gramians: [B, K, K].
    """
    return exact.rounding_residuals(columns, group, gramians, _scale(columns))


def _scale(columns: Sequence[Column]) -> float:
    """The power of two that keeps products of float64 gradients inside float64."""
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
