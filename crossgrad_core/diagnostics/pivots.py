"""Studentised estimates of the gap between group means and of the variance within groups."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.diagnostics.grouped import GroupedGramian, Groups
from crossgrad_core.diagnostics.interval import Interval
from crossgrad_core.diagnostics.resampling import Resamples

_DOUBLINGS = 60
_BISECTIONS = 24

_Pivot = Callable[[float], tuple[float, NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class StudentisedGap:
    """One block's resamples with what is known of the noise.

    Attributes:
        draws: The resamples, row 0 the sample itself.
        estimate: Unbiased estimate of the gap theta = ||near mean - far mean||^2.
        plain_gap: Squared distance of the sample means.
        floor: Variance of the estimate at theta = 0.
        floors: [R] the same in each resample.
    """

    draws: Resamples
    estimate: float
    plain_gap: float
    floor: float
    floors: NDArray[np.float64]

    @classmethod
    def of(cls, parts: GroupedGramian, groups: Groups, draws: Resamples) -> "StudentisedGap":
        """From the split Gramian and its resamples."""
        noise = draws.noise[1:]
        # The scale of a resample's noise goes with the square of its spread.
        relative = (draws.spread[1:] / draws.spread[0]) ** 2
        floors = relative * (float(noise.var()) / float(relative.mean()))
        return cls(
            draws=draws,
            estimate=parts.gap + float(draws.noise[0]),
            plain_gap=parts.gap,
            floor=_variance_without_gap(parts, groups),
            floors=floors,
        )

    def within(self, tails: tuple[float, float]) -> Interval:
        """sigma_w^2 by bootstrap-t of its logarithm."""
        values = self.draws.within
        errors = np.sqrt(self.draws.within_variance) / values
        if errors[0] == 0.0:
            return Interval(float(values[0]), float(values[0]))
        pivots = np.log(values[1:] / values[0]) / np.maximum(errors[1:], np.finfo(np.float64).tiny)
        low, high = np.quantile(pivots, tails)
        return Interval(
            float(values[0] * np.exp(-high * errors[0])),
            float(values[0] * np.exp(-low * errors[0])),
        )

    def gap_pivot(self, gap: float) -> tuple[float, NDArray[np.float64]]:
        """The studentised estimate if `gap` is the true one, and its resamples."""
        draws, root = self.draws, sqrt(gap)
        variance = 4.0 * gap * draws.shift_variance
        numerators = 2.0 * root * draws.shift[1:] + (draws.noise[1:] - draws.noise[0])
        observed = _studentised(self.estimate - gap, float(variance[0]) + self.floor)
        return observed, numerators / np.sqrt(_positive(variance[1:] + self.floors))

    def ratio_pivot(self, ratio: float) -> tuple[float, NDArray[np.float64]]:
        """The studentised estimate of gap - ratio * sigma_w^2 if the true ratio is `ratio`."""
        draws = self.draws
        gap = ratio * float(draws.within[0])
        root = sqrt(gap)
        variance = (
            4.0 * gap * draws.shift_variance
            + ratio**2 * draws.within_variance
            - 4.0 * ratio * root * draws.covariance
        )
        numerators = (
            gap
            + 2.0 * root * draws.shift[1:]
            + (draws.noise[1:] - draws.noise[0])
            - ratio * draws.within[1:]
        )
        observed = _studentised(self.estimate - gap, float(variance[0]) + self.floor)
        return observed, numerators / np.sqrt(_positive(variance[1:] + self.floors))

    def inverted(self, pivot: _Pivot, tails: tuple[float, float]) -> Interval:
        """The values >= 0 that the pivot does not reject."""

        def above(tail: float, value: float) -> bool:
            observed, resampled = pivot(value)
            return observed > float(np.quantile(resampled, tail))

        start = max(self.estimate, self.plain_gap, sqrt(self.floor))
        high, low = (_crossing(partial(above, tail), start) for tail in tails)
        return Interval(low, high)


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


def _variance_without_gap(parts: GroupedGramian, groups: Groups) -> float:
    """Variance of the estimated gap where the true gap is zero, in units of the scale squared."""
    (n, m), (f, g) = groups.sizes, groups.unseen
    near = max(_squared_covariance(parts.near), 0.0)
    far = max(_squared_covariance(parts.far), 0.0)
    meeting = float((parts.cross**2).sum()) / ((n - 1) * (m - 1))
    own = f**2 * near / (n * (n - 1)) + g**2 * far / (m * (m - 1))
    return 2.0 * own + 4.0 * f * g * meeting / (n * m)


def _squared_covariance(deviations: NDArray[np.float64]) -> float:
    """Unbiased estimate of tr(Sigma^2) from dot products of deviations [n, n], any distribution.

    Source: Himeno and Yamada 2014.
    """
    n = len(deviations)
    squared = np.diag(deviations)
    trace = float(squared.sum()) / (n - 1)
    plain = float((deviations**2).sum()) / (n - 1) ** 2
    fourth = float((squared**2).sum()) / (n - 1)
    factor = (n - 1) / (n * (n - 2) * (n - 3))
    return factor * ((n - 1) * (n - 2) * plain + trace**2 - n * fourth)


def _studentised(numerator: float, variance: float) -> float:
    return numerator / sqrt(max(variance, np.finfo(np.float64).tiny))


def _positive(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(values, np.finfo(np.float64).tiny)
