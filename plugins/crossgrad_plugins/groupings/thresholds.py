"""Where to cut a set of numbers in two."""

import numpy as np
from numpy.typing import NDArray


def otsu_threshold(values: NDArray[np.float64]) -> float:
    """The cut between neighbouring values [N >= 1] with the least variance within both sides.

    Exact: every cut between two different sorted values is tried, there is no histogram. All values
    equal: that value.

    Source: Otsu 1979 (largest variance between classes).
    """
    ordered = np.sort(values)
    sums, total = np.cumsum(ordered)[:-1], ordered.sum()
    left = np.arange(1, len(ordered))
    right = len(ordered) - left
    gap = sums / left - (total - sums) / np.maximum(right, 1)
    between = np.where(np.diff(ordered) > 0.0, left * right * gap**2, -1.0)
    return _cut(ordered, between)


def gap_threshold(values: NDArray[np.float64]) -> float:
    """The middle of the widest gap between neighbouring sorted values [N >= 1]."""
    ordered = np.sort(values)
    return _cut(ordered, np.where(np.diff(ordered) > 0.0, np.diff(ordered), -1.0))


def _cut(ordered: NDArray[np.float64], scores: NDArray[np.float64]) -> float:
    """The middle of the neighbours [N] with the best score [N-1]; the maximum where none is > 0."""
    if len(scores) == 0 or scores.max() <= 0.0:
        return float(ordered[-1])
    place = int(scores.argmax())
    return float((ordered[place] + ordered[place + 1]) / 2.0)
