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
    return _cut(ordered, _between(ordered))


def otsu_separability(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """[...] share of the variance of values [..., N >= 2] that lies between both sides of the cut.

    1 for two values, 3/4 for very many that are evenly spread; 0 where all values are equal.

    Source: Otsu 1979 (eta, equation 14).
    """
    ordered = np.sort(samples, axis=-1)
    between = _between(ordered).max(axis=-1) / ordered.shape[-1] ** 2
    whole = ordered.var(axis=-1)
    shares = np.zeros_like(whole)
    np.divide(between, whole, out=shares, where=(whole > 0.0) & (between > 0.0))
    return np.asarray(shares)


def _between(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., N-1] N^2 times the variance between both sides of each cut of sorted values [..., N].

    -1 where neighbours are equal.
    """
    sums, total = np.cumsum(ordered, axis=-1)[..., :-1], ordered.sum(axis=-1, keepdims=True)
    left = np.arange(1, ordered.shape[-1])
    right = ordered.shape[-1] - left
    gap = sums / left - (total - sums) / np.maximum(right, 1)
    return np.where(np.diff(ordered, axis=-1) > 0.0, left * right * gap**2, -1.0)


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
