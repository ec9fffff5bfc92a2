"""Confidence intervals of the variance split, by a studentised bootstrap over cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import GroupedGramian, Groups, split_of
from crossgrad_plugins.diagnostics.resampling import Resamples

#: The first value is the maximum share of the error probability that moves from the lower to the
#: upper end of the ratio's interval. The second value is the share of sigma_w^2 in the variance
#: from which on this maximum applies. The error is moved because a sample with too few long
#: gradients gives a too small sigma_w^2 and a too large ratio.
_MOVED = 0.4
_WITHIN_RULES = 1.0 / 3.0
#: The unbiased estimate of tr(Sigma^2), with covariance Sigma, needs four views of each group.
SMALLEST_FOR_INTERVALS = 4
#: A variance below this share of the squared lengths counts as a rounding error.
_NEGLIGIBLE = 1e-13
#: Share of the error probability of sigma_w^2's interval that is assigned to its upper end. The
#: split is uneven because a small sample contains too few of the rare long gradients more often
#: than too many.
_UPPER_SHARE = 0.2
_DOUBLINGS = 60
_BISECTIONS = 24


@dataclass(frozen=True)
class Interval:
    """A confidence interval; the upper end is infinite if there is no bound.

    Both ends are NaN if the interval is unknown or if every possible value is rejected.
    """

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if the value is inside the interval, ends included."""
        return self.low <= value <= self.high

    def times(self, factor: float) -> "Interval":
        """Return the interval of the quantity times a non-negative factor."""
        return Interval(self.low * factor, self.high * factor)


@dataclass(frozen=True, eq=False)
class Pivot:
    """The studentised estimate and its resamples, for an assumed true value.

    Attributes:
        observed: The studentised estimate of the sample.
        resampled: [R] studentised estimates of the resamples.
        lower_share: Share of the error probability that is assigned to the lower end of the
            interval.
    """

    observed: float
    resampled: NDArray[np.float64]
    lower_share: float = 0.5

    def above(self, level: float, *, lower_end: bool) -> bool:
        """Return True if the sample is unlikely unless the true value is larger than assumed."""
        error = 1.0 - level
        tail = 1.0 - error * self.lower_share if lower_end else error * (1.0 - self.lower_share)
        return self.observed > float(np.quantile(self.resampled, tail))


@dataclass(frozen=True, eq=False)
class StudentisedGap:
    """The resamples of one block and the variance of its noise.

    Attributes:
        draws: The resamples, with the sample itself in row 0; their shifts are scaled to the
            variance along the true gap.
        estimate: Unbiased estimate of the squared gap theta = ||near mean - far mean||^2.
        plain_gap: Squared distance of the sample means.
        floor: Variance of the estimate if theta is 0.
        floors: [R] `floor` of each resample.
    """

    draws: Resamples
    estimate: float
    plain_gap: float
    floor: float
    floors: NDArray[np.float64]

    @classmethod
    def of(cls, parts: GroupedGramian, groups: Groups, draws: Resamples) -> "StudentisedGap":
        """Combine the split Gramian with its resamples."""
        noise = draws.noise[1:]
        # The noise of a resample is scaled by the square of its spread.
        relative = (draws.spread[1:] / draws.spread[0]) ** 2
        floors = relative * (float(noise.var()) / float(relative.mean()))
        floor = _variance_without_gap(parts, groups)
        return cls(
            draws=draws.along_gap(_along_the_true_gap(draws, parts.gap, floor)),
            estimate=parts.gap + float(draws.noise[0]),
            plain_gap=parts.gap,
            floor=floor,
            floors=floors,
        )

    def within(self, tails: tuple[float, float]) -> Interval:
        """Return the interval of sigma_w^2, from a bootstrap-t of its logarithm."""
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

    def gap_pivot(self, gap: float) -> Pivot:
        """Return the studentised estimate and its resamples if `gap` is the true squared gap."""
        draws, root = self.draws, sqrt(gap)
        variance = 4.0 * gap * draws.shift_variance
        numerators = 2.0 * root * draws.shift[1:] + (draws.noise[1:] - draws.noise[0])
        observed = _studentised(self.estimate - gap, float(variance[0]) + self.floor)
        return Pivot(observed, numerators / np.sqrt(_positive(variance[1:] + self.floors)))

    def ratio_pivot(self, ratio: float) -> Pivot:
        """Return the studentised value of gap - ratio * sigma_w^2 and its resamples.

        The calculation assumes that `ratio` is the true ratio.
        """
        draws = self.draws
        gap = ratio * float(draws.within[0])
        root = sqrt(gap)
        of_gap = 4.0 * gap * draws.shift_variance
        of_within = ratio**2 * draws.within_variance
        variance = of_gap + of_within - 4.0 * ratio * root * draws.covariance
        numerators = (
            gap
            + 2.0 * root * draws.shift[1:]
            + (draws.noise[1:] - draws.noise[0])
            - ratio * draws.within[1:]
        )
        whole = float(of_gap[0]) + self.floor + float(of_within[0])
        moved = min(1.0, float(of_within[0]) / (_WITHIN_RULES * whole)) if whole > 0.0 else 0.0
        return Pivot(
            observed=_studentised(self.estimate - gap, float(variance[0]) + self.floor),
            resampled=numerators / np.sqrt(_positive(variance[1:] + self.floors)),
            lower_share=0.5 - _MOVED * moved,
        )

    @property
    def start(self) -> float:
        """Positive start value for the search of an interval's upper end."""
        return max(self.estimate, self.plain_gap, sqrt(self.floor))


def _along_the_true_gap(draws: Resamples, gap: float, floor: float) -> float:
    """Return the variance of the shift along the true gap, divided by the one along the sample gap.

    The sample gap d is the true gap plus noise. The noise is largest in the directions in which
    gradients vary most. Let Sigma be the covariance of the difference of the means. Noise adds
    tr(Sigma^2), which is half of the `floor`, to d' Sigma d, and adds tr(Sigma) to |d|^2. Only half
    of each term is subtracted, because the terms are uncertain with a dozen views. A smaller part
    is subtracted if the whole gap could be noise.

    Without the subtraction, 95 % intervals of sigma_b^2 contain the true value in up to 99.5 % of
    the cases if few directions dominate. With the full subtraction, they contain it in 84 to 97 %
    of the cases.
    """
    noise, along = float(draws.spread[0]), float(draws.shift_variance[0]) * gap
    if noise <= 0.0 or along <= 0.0:
        return 1.0
    taken = 0.5 * min(1.0, gap / (2.0 * noise))
    return max(along - taken * floor / 2.0, 0.0) / (gap - taken * noise) * (gap / along)


def _variance_without_gap(parts: GroupedGramian, groups: Groups) -> float:
    """Return the variance of the estimated gap for a true gap of zero, in squared scale units."""
    (n, m), (f, g) = groups.sizes, groups.unseen
    near = max(_squared_covariance(parts.near), 0.0)
    far = max(_squared_covariance(parts.far), 0.0)
    meeting = float((parts.cross**2).sum()) / ((n - 1) * (m - 1))
    within = f**2 * near / (n * (n - 1)) + g**2 * far / (m * (m - 1))
    return 2.0 * within + 4.0 * f * g * meeting / (n * m)


def _squared_covariance(deviations: NDArray[np.float64]) -> float:
    """Estimate tr(Sigma^2) without bias from dot products of deviations [n, n].

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
    """Estimate confidence intervals from the Gramian [V, V] of one block.

    The bootstrap draws cameras with replacement within their groups. Pairs of a camera with its own
    copy are left out, because their dot product is a squared norm. The interval of sigma_w^2 is
    studentised on the logarithmic scale.

    sigma_b^2 is quadratic in the distance of the group means, so its noise depends on the squared
    distance theta. The interval contains every theta that the estimate does not reject. Each test
    uses the standard error for its own theta, and critical values from a bootstrap that is moved to
    this theta. The interval of the ratio sigma_b^2 / sigma_w^2 is computed in the same way from
    theta - ratio sigma_w^2. The larger the part of sigma_w^2 in the noise of this difference, the
    larger the share of the error probability at the upper end. The ends are never negative,
    although an estimate may be negative.

    All intervals are unknown (NaN) with fewer than four views in a group, or without variance. The
    intervals of sigma_b^2 and of the ratio are also unknown if the estimate is far below 0, because
    then even the value 0 is rejected.

    Source: Efron and Tibshirani 1993 for bootstrap-t and intervals by test inversion; Chen and Qin
    2010 for the variance of the statistic. `benchmarks/interval_coverage.py` measures how often the
    intervals contain the true value.
    """
    parts = GroupedGramian.of(gramian, groups)
    within, between = split_of(parts, groups)
    if min(groups.sizes) < SMALLEST_FOR_INTERVALS or parts.scale <= 0.0 or within <= _NEGLIGIBLE:
        return SplitIntervals(UNKNOWN, UNKNOWN, UNKNOWN)
    if max(groups.unseen) <= 0.0:
        return _points(parts.scale * within, parts.scale * between)
    problem = StudentisedGap.of(parts, groups, Resamples.of(parts, groups, resamples, rng))
    unit = groups.shares[0] * groups.shares[1]
    gap = inverted(problem.gap_pivot, problem.start, level)
    ratio = inverted(problem.ratio_pivot, problem.start, level)
    return SplitIntervals(
        within=problem.within(_leaning_tails(level)).times(parts.scale),
        between=gap.times(unit * parts.scale),
        ratio=ratio.times(unit),
    )


def _points(within: float, between: float) -> SplitIntervals:
    """Return intervals of zero width.

    If every camera was probed, the values are exact.
    """
    figures = (within, between, between / within)
    return SplitIntervals(*(Interval(figure, figure) for figure in figures))


def _leaning_tails(level: float) -> tuple[float, float]:
    """Return the quantiles of the pivot for the (upper, lower) end of sigma_w^2's interval."""
    upper = (1.0 - level) * _UPPER_SHARE
    return upper, upper + level


UNKNOWN = Interval(float("nan"), float("nan"))


def inverted(pivot: Callable[[float], Pivot], start: float, level: float) -> Interval:
    """Return the interval of the values >= 0 that are not rejected; NaN if all are rejected.

    Args:
        pivot: Function of a value; returns the studentised estimate if this value is the true
            value.
        start: Positive value near the expected upper end.
        level: Confidence level of the interval.
    """
    # If the value 0 is rejected as too large, all larger values are also rejected. The interval [0,
    # 0] would then wrongly state that the value is exactly 0.
    if not pivot(0.0).above(level, lower_end=False):
        return UNKNOWN
    return Interval(
        low=_crossing(lambda value: pivot(value).above(level, lower_end=True), start),
        high=_crossing(lambda value: pivot(value).above(level, lower_end=False), start),
    )


def _crossing(above: Callable[[float], bool], start: float) -> float:
    """Return the value in [0, inf) at which `above` becomes false; infinite if it never does."""
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
