"""Confidence intervals of the variance split by a studentised bootstrap over cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.diagnostics.grouped import GroupedGramian, Groups
from crossgrad_core.diagnostics.resampling import Resamples
from crossgrad_core.diagnostics.variance import split_of

#: The unbiased estimate of tr(Sigma^2) needs four views of each group.
SMALLEST_FOR_INTERVALS = 4
TAILS=(0.01,0.96)
_DOUBLINGS = 60
_BISECTIONS = 40

_Pivot = Callable[[float], tuple[float, NDArray[np.float64]]]


@dataclass(frozen=True)
class Interval:
    """A confidence interval; NaN where it cannot be told, infinite where there is no upper end."""

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether the value lies inside, ends included."""
        return self.low <= value <= self.high

    def times(self, factor: float) -> "Interval":
        """The interval of the quantity times a factor >= 0."""
        return Interval(self.low * factor, self.high * factor)


UNKNOWN = Interval(float("nan"), float("nan"))


@dataclass(frozen=True)
class SplitIntervals:
    """Intervals of sigma_w^2, of sigma_b^2 and of their ratio sigma_b^2 / sigma_w^2."""

    within: Interval
    between: Interval
    ratio: Interval


def split_intervals(
    gramian: NDArray[np.float64],
    groups: Groups,
    rng: np.random.Generator,
    *,
    resamples: int = 999,
    level: float = 0.95,
) -> SplitIntervals:
    """Intervals from the Gramian [V, V] of one block.

    Cameras are resampled within their groups; pairs of a camera with its own copy are left out, for
    they would add the camera's squared norm to every dot product between cameras. sigma_w^2 is
    studentised on the logarithmic scale. sigma_b^2 is quadratic in the distance theta of the group
    means, so its noise depends on theta: the interval holds every theta that the estimate, with the
    standard error that belongs to *that* theta, does not reject; the bootstrap is moved to theta
    for the critical values. The ends are never negative, whereas the estimate may be.

    Unknown (NaN) with fewer than four views in a group, or without any variance.

    Source: bootstrap-t, Efron and Tibshirani 1993, ch. 12; test inversion, ibid. ch. 12.5 and
    DiCiccio and Efron 1996; variance of the statistic, Chen and Qin 2010.
    """
    parts = GroupedGramian.of(gramian, groups)
    within, between = split_of(parts, groups)
    if min(groups.sizes) < SMALLEST_FOR_INTERVALS or parts.scale <= 0.0 or within <= 0.0:
        return SplitIntervals(UNKNOWN, UNKNOWN, UNKNOWN)
    if max(groups.unseen) <= 0.0:
        exact = VarianceFigures(parts.scale * within, parts.scale * between, between / within)
        return exact.as_points()
    problem = _Problem.of(parts, groups, Resamples.of(parts, groups, resamples, rng))
    tails = ((1.0 - level) / 2.0, (1.0 + level) / 2.0)
    unit = groups.shares[0] * groups.shares[1]
    gap = problem.inverted(problem.gap_pivot, tails)
    ratio = problem.inverted(problem.ratio_pivot, tails)
    return SplitIntervals(
        within=problem.within(TAILS).times(parts.scale),
        between=gap.times(unit * parts.scale),
        ratio=ratio.times(unit),
    )


@dataclass(frozen=True)
class VarianceFigures:
    """Figures that are known exactly, because every camera was probed."""

    within: float
    between: float
    ratio: float

    def as_points(self) -> SplitIntervals:
        """Intervals without extent."""
        return SplitIntervals(
            Interval(self.within, self.within),
            Interval(self.between, self.between),
            Interval(self.ratio, self.ratio),
        )


@dataclass(frozen=True, eq=False)
class _Problem:
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
    def of(cls, parts: GroupedGramian, groups: Groups, draws: Resamples) -> "_Problem":
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
