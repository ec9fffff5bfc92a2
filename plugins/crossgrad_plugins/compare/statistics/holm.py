"""Holm's correction for several tests (Scandinavian Journal of Statistics 6, 1979)."""

from collections.abc import Sequence
from math import isnan


def holm(values: Sequence[float]) -> list[float]:
    """Adjusted p-values in the given order; NaN, a test that was not made, stays and counts not."""
    known = sorted((value, index) for index, value in enumerate(values) if not isnan(value))
    adjusted, largest = list(values), 0.0
    for rank, (value, index) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * value))
        adjusted[index] = largest
    return adjusted
