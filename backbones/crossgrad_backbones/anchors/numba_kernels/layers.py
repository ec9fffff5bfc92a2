"""Kernels around the matrix products of the networks (CPU, float32, rows in C order)."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

_Floats: TypeAlias = NDArray[np.float32]
_Ints: TypeAlias = NDArray[np.int64]

#: Rows that one thread takes at a time.
SHARE = 256

_ZERO = np.float32(0)


@kernel
def join(jobs: Jobs, features: _Floats, rows: _Ints, views: _Floats, out: _Floats) -> None:
    """Writes [A, F + V]: rows [A] of the features [Q, F], then the views [A, V]."""
    anchors, feature, view = len(rows), features.shape[1], views.shape[1]
    parts = (anchors + SHARE - 1) // SHARE
    part = next_job(jobs, parts)
    while part < parts:
        for a in range(part * SHARE, min(anchors, (part + 1) * SHARE)):
            row = rows[a]
            for c in range(feature):
                out[a, c] = features[row, c]
            for c in range(view):
                out[a, feature + c] = views[a, c]
        part = next_job(jobs, parts)


@kernel
def rectify_back(
    jobs: Jobs, first: int, anchors: int, column: int, hidden: _Floats, gradient: _Floats
) -> None:
    """Clears the gradient in place where the rectified numbers are 0.

    Args:
        jobs: From `share`.
        first: The first anchor.
        anchors: n.
        column: Column of `hidden` that belongs to the first one of the gradient.
        hidden: [A, 3 H] rectified numbers.
        gradient: [n or more, H or 3 H].
    """
    width = gradient.shape[1]
    parts = (anchors + SHARE - 1) // SHARE
    part = next_job(jobs, parts)
    while part < parts:
        for n in range(part * SHARE, min(anchors, (part + 1) * SHARE)):
            mine = gradient[n]
            theirs = hidden[first + n, column : column + width]
            for c in range(width):
                mine[c] = mine[c] if theirs[c] > _ZERO else _ZERO
        part = next_job(jobs, parts)
