"""Intervals by inversion of a test: all values that the estimate does not reject."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.intervals.interval import UNKNOWN, Interval

_DOUBLINGS = 60
_BISECTIONS = 24


@dataclass(frozen=True, eq=False)
class Pivot:
    """The studentised estimate if a value is the true one.

    Attributes:
        observed: Of the sample.
        resampled: [R] of the resamples.
        lower_share: Share of the interval's error that falls on its lower end.
    """

    observed: float
    resampled: NDArray[np.float64]
    lower_share: float = 0.5

    def above(self, level: float, *, lower_end: bool) -> bool:
        """Whether the true value must be larger than this for the estimate to be credible."""
        error = 1.0 - level
        tail = 1.0 - error * self.lower_share if lower_end else error * (1.0 - self.lower_share)
        return self.observed > float(np.quantile(self.resampled, tail))


def inverted(pivot: Callable[[float], Pivot], start: float, level: float) -> Interval:
    """The values >= 0 that are not rejected; unknown (NaN) where there are none.

    Args:
        pivot: Value -> studentised estimate if that value is the true one.
        start: Positive; about as large as the upper end.
        level: Of the interval.
    """
    # An estimate too low for 0 is so for all larger values: [0, 0] would say that it is exactly 0.
    if not pivot(0.0).above(level, lower_end=False):
        return UNKNOWN
    return Interval(
        low=_crossing(lambda value: pivot(value).above(level, lower_end=True), start),
        high=_crossing(lambda value: pivot(value).above(level, lower_end=False), start),
    )


def _crossing(above: Callable[[float], bool], start: float) -> float:
    """Where `above` turns from true to false on [0, inf); infinite where it does not."""
    if not above(0.0):
        return 0.0
    low, high = 0.0, start
    for _ in range(_DOUBLINGS):
        if not above(high):
            break
        low, high = high, 2.0 * high
    else:
        return float("inf")
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if above(middle) else (low, middle)
    return (low + high) / 2.0
