"""The uncertainty of a difference between arms: estimates, intervals, p-values, verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import ceil, inf, isnan, nan, sqrt
from typing import Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

DRAWS: Final = 2000
_TWO: Final = 2
_SEED: Final = 20_150_101
#: The interval is computed by bootstrap from this number of pairs on.
BOOTSTRAP_FROM: Final = 10
#: Confidence level of the interval for a difference, and of the interval for equivalence.
WIDE, NARROW = 0.95, 0.90
MEAN, IQM = "mean, Student's t", "IQM, bootstrap"
_UNKNOWN = (-inf, inf)
Interval: TypeAlias = tuple[float, float]
#: Maximum number of pairs that a report suggests.
MOST_PAIRS: Final = 1000
#: Up to this number of comparisons, verdicts are not corrected for multiple tests.
UNCORRECTED: Final = 5


def iqm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the interquartile mean along the last axis.

    A value at the edge of the middle half has the weight of its part inside the half. The
    interquartile mean of two values is their mean. Of three values, the middle value has the weight
    2/3. `scipy.stats.trim_mean` is not used, because it only removes whole values.

    Args:
        values: [..., n] numbers, n >= 1.

    Returns:
        [...] the interquartile means.
    """
    count = values.shape[-1]
    first = np.arange(count, dtype=np.float64)
    weights = np.minimum(first + 1.0, 0.75 * count) - np.maximum(first, 0.25 * count)
    weights = np.clip(weights, 0.0, None)
    means: NDArray[np.float64] = np.sort(values, axis=-1) @ (weights / weights.sum())
    return means


@dataclass(frozen=True)
class Bootstrap:
    """The estimates from many resampled sets of pairs.

    Attributes:
        draws: [DRAWS] estimates, sorted.
        freedom: Degrees of freedom of the variance within scenes.
    """

    draws: NDArray[np.float64]
    freedom: int

    @classmethod
    def of(cls, values: NDArray[np.float64], scenes: Sequence[str]) -> "Bootstrap":
        """Resample pairs within their scenes; scenes with a single pair are resampled together.

        Args:
            values: [n] differences, n >= 2.
            scenes: [n] scene of each difference.
        """
        rng = np.random.default_rng(_SEED)
        strata = _strata(scenes)
        stretched, resampled = np.empty(len(values)), np.empty((DRAWS, len(values)))
        of_two = [indices for indices in strata if len(indices) == _TWO]
        pool = _deviations(values, of_two)
        for stratum in strata:
            sample, count = values[stratum], len(stratum)
            stretch = sqrt(count / (count - 1)) if count > 1 else 1.0
            stretched[stratum] = sample.mean() + stretch * (sample - sample.mean())
            source = sample.mean() + pool if count == _TWO else stretched[stratum]
            drawn = rng.integers(0, len(source), (DRAWS, count))
            resampled[:, stratum] = source[drawn]
        draws = iqm(resampled) + (iqm(values) - iqm(stretched))
        freedom = max(1, len(values) - len(strata))
        return cls(np.sort(draws), freedom)

    def interval(self, level: float) -> tuple[float, float]:
        """Return the two-sided interval for a confidence level such as 0.95."""
        from scipy.special import ndtr, stdtrit

        tail = float(ndtr(-stdtrit(self.freedom, 0.5 + level / 2.0)))
        low, high = np.quantile(self.draws, [tail, 1.0 - tail])
        return float(low), float(high)

    def cdf(self, border: float) -> float:
        """Return the p-value of the hypothesis that the true value is at most `border`."""
        return self._tail(_share(self.draws, border), float(np.median(self.draws)) - border)

    def sf(self, border: float) -> float:
        """Return the p-value of the hypothesis that the true value is at least `border`."""
        return self._tail(1.0 - _share(self.draws, border), border - float(np.median(self.draws)))

    def _tail(self, share: float, distance: float) -> float:
        """Return the p-value for a share of the draws, consistent with the widened interval.

        If a border is beyond all draws, its distance from the median of the draws, in standard
        deviations, gives the p-value. Otherwise the p-value could not be smaller than one divided
        by the number of draws.
        """
        from scipy.special import ndtri, stdtr

        least = 0.5 / DRAWS
        score = float(ndtri(min(max(share, least), 1.0 - least)))
        if share < least:
            spread = float(self.draws.std())
            score = min(score, -distance / spread) if spread > 0.0 else -inf
        return float(stdtr(self.freedom, score))


def _deviations(
    values: NDArray[np.float64], strata: Sequence[NDArray[np.intp]]
) -> NDArray[np.float64]:
    """Return unbiased deviations from the scene's mean, for scenes with two pairs."""
    deviations = [sqrt(_TWO) * (values[stratum] - values[stratum].mean()) for stratum in strata]
    return np.concatenate(deviations) if deviations else np.zeros(0)


def _share(draws: NDArray[np.float64], border: float) -> float:
    """Return the share of sorted draws below a border.

    Draws on the border count half.
    """
    below = int(np.searchsorted(draws, border))
    up_to = int(np.searchsorted(draws, border, side="right"))
    return (below + up_to) / (2 * len(draws))


def _strata(scenes: Sequence[str]) -> list[NDArray[np.intp]]:
    names = np.asarray(scenes)
    strata = [np.flatnonzero(names == name) for name in dict.fromkeys(scenes)]
    single = [stratum for stratum in strata if len(stratum) == 1]
    several = [stratum for stratum in strata if len(stratum) > 1]
    return [*several, np.concatenate(single)] if single else several


@dataclass(frozen=True)
class SceneEstimate:
    """The mean difference on one scene with at least two pairs.

    Attributes:
        scene: Name of the scene.
        center: The mean difference.
        wide: The 95 % interval from Student's t distribution.
    """

    scene: str
    center: float
    wide: Interval


@dataclass(frozen=True)
class Estimate:
    """A difference with its uncertainty.

    Attributes:
        pairs: Number of pairs.
        scenes: Number of scenes of the pairs.
        margin: Largest difference that counts as no difference in practice.
        center: The estimate: the mean below 10 pairs, the interquartile mean from 10 pairs on.
        method: The kind of mean, and the method of the interval.
        wide: The 95 % interval; if it excludes zero, there is a difference.
        narrow: The 90 % interval; if it is within the margin, the arms are equivalent.
        deviation: Standard deviation of the pairs' differences; NaN for a single pair.
        p_different: p-value of the hypothesis of no difference (two-sided).
        p_equivalent: p-value of the hypothesis that the difference is at least the margin in either
            direction (two one-sided tests).
        p_above: p-value of the hypothesis that the difference is at least the margin upwards
            (one-sided).
        needed: Estimated number of pairs with which the 90 % interval fits into the margins; None
            if it cannot be estimated.
        by_scene: The estimate of each scene; empty if there is only one scene. It shows a scene
            that differs from the others, which an interquartile mean can hide.
    """

    pairs: int
    scenes: int
    margin: float
    center: float
    method: str
    wide: Interval = _UNKNOWN
    narrow: Interval = _UNKNOWN
    deviation: float = nan
    p_different: float = nan
    p_equivalent: float = nan
    p_above: float = nan
    needed: int | None = None
    by_scene: tuple[SceneEstimate, ...] = ()

    @property
    def differs(self) -> bool:
        """True if the 95 % interval excludes zero."""
        return self.wide[0] > 0.0 or self.wide[1] < 0.0

    @property
    def is_small(self) -> bool:
        """True if the 90 % interval is within the margin."""
        return -self.margin < self.narrow[0] and self.narrow[1] < self.margin


class Law(Protocol):
    """The distribution of an estimate: Student's t from SciPy, or a bootstrap."""

    def interval(self, level: float) -> Interval:
        """Return the two-sided interval for a confidence level such as 0.95."""

    def cdf(self, border: float) -> float:
        """Return the p-value of the hypothesis that the true value is at most `border`."""

    def sf(self, border: float) -> float:
        """Return the p-value of the hypothesis that the true value is at least `border`."""


def estimate(differences: Sequence[float], scenes: Sequence[str], margin: float) -> Estimate:
    """Estimate a difference from pairs of runs.

    Args:
        differences: Finite difference of each pair; at least one.
        scenes: The scene of each pair.
        margin: Largest difference that counts as no difference in practice.
    """
    values = np.asarray(differences, dtype=np.float64)
    by_bootstrap = len(values) >= BOOTSTRAP_FROM
    common = Estimate(
        pairs=len(values),
        scenes=len(set(scenes)),
        margin=margin,
        center=float(iqm(values) if by_bootstrap else values.mean()),
        method=IQM if by_bootstrap else MEAN,
        by_scene=_by_scene(values, scenes),
    )
    if len(values) == 1:
        return common
    law: Law = Bootstrap.of(values, scenes) if by_bootstrap else student(values)
    deviation, narrow = float(values.std(ddof=1)), _floats(law.interval(NARROW))
    above, below = float(law.sf(margin)), float(law.cdf(-margin))
    return replace(
        common,
        wide=_floats(law.interval(WIDE)),
        narrow=narrow,
        deviation=deviation,
        p_different=min(1.0, 2.0 * float(min(law.sf(0.0), law.cdf(0.0)))),
        p_equivalent=max(above, below),
        p_above=above,
        needed=_wider(narrow, len(values), margin)
        if by_bootstrap
        else pairs_needed(deviation, margin),
    )


def student(values: NDArray[np.float64]) -> Law:
    """Return Student's t distribution of the mean of two or more values."""
    from scipy.stats import t

    error = float(values.std(ddof=1)) / sqrt(len(values))
    if error == 0.0:
        return Bootstrap(values[:1], len(values) - 1)  # SciPy does not accept a scale of 0.
    law: Law = t(len(values) - 1, loc=values.mean(), scale=error)
    return law


def pairs_needed(deviation: float, margin: float) -> int | None:
    """Return how many pairs are needed until the 90 % interval of a mean fits into the margins.

    Args:
        deviation: Standard deviation of the pairs' differences.
        margin: The margin, which must be above 0.

    Returns:
        The number of pairs, or None if it is above 1,000.
    """
    from scipy.special import stdtrit

    pairs = np.arange(2, MOST_PAIRS + 1)
    enough = pairs[stdtrit(pairs - 1, 0.5 + NARROW / 2.0) * deviation <= margin * np.sqrt(pairs)]
    return int(enough[0]) if len(enough) else None


def _wider(narrow: Interval, pairs: int, margin: float) -> int | None:
    """Like `pairs_needed`, but for an interquartile mean with a known interval."""
    needed = pairs * ((narrow[1] - narrow[0]) / (2.0 * margin)) ** 2
    return max(2, ceil(needed)) if needed <= MOST_PAIRS else None


def _by_scene(values: NDArray[np.float64], scenes: Sequence[str]) -> tuple[SceneEstimate, ...]:
    names = np.asarray(scenes)
    of_scene = {scene: values[names == scene] for scene in dict.fromkeys(scenes)}
    return tuple(
        SceneEstimate(scene, float(sample.mean()), _floats(student(sample).interval(WIDE)))
        for scene, sample in of_scene.items()
        if 1 < len(sample) < len(values)
    )


def _floats(interval: Interval) -> Interval:
    return float(interval[0]), float(interval[1])


class Verdict(StrEnum):
    """The verdict on a difference."""

    DIFFERENT = "different"
    EQUIVALENT = "equivalent"
    INCONCLUSIVE = "inconclusive"


def verdicts(family: Sequence[Estimate]) -> list[Verdict]:
    """Return the verdict on each comparison of a table.

    The verdict is `different` if the 95 % interval excludes zero, else `equivalent` if the 90 %
    interval is within the margin. If a table has more than five comparisons, a second condition
    applies: the p-value, corrected by Holm's method, must be below the level of the test.
    """
    if len(family) <= UNCORRECTED:
        return [_verdict(member.differs, member.is_small) for member in family]
    different = corrected([member.p_different for member in family])
    equivalent = corrected([member.p_equivalent for member in family])
    return [
        _verdict(member.differs and p < 1.0 - WIDE, member.is_small and q < (1.0 - NARROW) / 2.0)
        for member, p, q in zip(family, different, equivalent, strict=True)
    ]


def corrected(values: Sequence[float]) -> list[float]:
    """Return the p-values of a table, adjusted by Holm's method if there are more than five."""
    return holm(values) if len(values) > UNCORRECTED else list(values)


def holm(values: Sequence[float]) -> list[float]:
    """Return p-values adjusted by Holm's method (Scandinavian Journal of Statistics 6, 1979).

    NaN stands for a test that was not made. It is returned unchanged and does not count.
    """
    ranked = sorted((value, index) for index, value in enumerate(values) if not isnan(value))
    adjusted, largest = list(values), 0.0
    for rank, (value, index) in enumerate(ranked):
        largest = max(largest, min(1.0, (len(ranked) - rank) * value))
        adjusted[index] = largest
    return adjusted


def opposed(found: Estimate, verdict: Verdict, margin: float) -> tuple[SceneEstimate, ...]:
    """Return the scenes whose own 95 % intervals contradict the verdict of all scenes together.

    A scene contradicts the verdict `different` if its own difference has the opposite sign. A scene
    contradicts the verdict `equivalent` if its own difference is beyond the margin.
    """
    if verdict is Verdict.INCONCLUSIVE:
        return ()
    sign = 1.0 if found.center > 0.0 else -1.0
    return tuple(
        scene_estimate
        for scene_estimate in found.by_scene
        if (
            max(sign * limit for limit in scene_estimate.wide) < 0.0
            if verdict is Verdict.DIFFERENT
            else scene_estimate.wide[0] > margin or scene_estimate.wide[1] < -margin
        )
    )


def _verdict(differs: bool, is_small: bool) -> Verdict:
    if differs:
        return Verdict.DIFFERENT
    return Verdict.EQUIVALENT if is_small else Verdict.INCONCLUSIVE
