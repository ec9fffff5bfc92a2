"""Confidence intervals of the variance split by a studentised bootstrap over cameras."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import GroupedGramian, Groups
from crossgrad_plugins.diagnostics.intervals.interval import UNKNOWN, Interval
from crossgrad_plugins.diagnostics.intervals.inversion import inverted
from crossgrad_plugins.diagnostics.intervals.pivots import StudentisedGap
from crossgrad_plugins.diagnostics.intervals.resampling import Resamples
from crossgrad_plugins.diagnostics.variance import split_of

#: The unbiased estimate of tr(Sigma^2) needs four views of each group.
SMALLEST_FOR_INTERVALS = 4
#: A variance of this size, relative to the squared lengths, is rounding.
_NEGLIGIBLE = 1e-13
#: Share of the error of sigma_w^2's interval that falls on its upper end. A few views miss rare
#: long gradients more often than they hold too many, so the error is not split evenly.
_UPPER_SHARE = 0.2


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
    for the critical values. The ratio's interval is made the same way from theta - ratio sigma_w^2;
    the more of its noise comes from sigma_w^2, the more of its error falls on its upper end. The
    ends are never negative, whereas the estimate may be.

    Unknown (NaN) with fewer than four views in a group, or without any variance, and of sigma_b^2
    and the ratio where the estimate lies so far below 0 that even 0 is rejected.

    Source: bootstrap-t and intervals by test inversion, Efron and Tibshirani 1993; variance of the
    statistic, Chen and Qin 2010. Coverage: `benchmarks/interval_coverage.py`.
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
    """Intervals without extent, for figures that are exact because every camera was probed."""
    figures = (within, between, between / within)
    return SplitIntervals(*(Interval(figure, figure) for figure in figures))


def _leaning_tails(level: float) -> tuple[float, float]:
    """Quantiles of the pivot that give the (upper, lower) end of sigma_w^2's interval."""
    upper = (1.0 - level) * _UPPER_SHARE
    return upper, upper + level
