"""A difference estimated from pairs of runs, with intervals and p-values."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, nan, sqrt
from typing import Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.compare.statistics.bootstrap import Bootstrap, iqm

#: From so many pairs on the interval comes from the bootstrap.
BOOTSTRAP_FROM: Final = 10
#: Levels of the interval that shows a difference and of the one that shows equivalence.
WIDE, NARROW = 0.95, 0.90
MEAN, IQM = "mean, Student's t", "IQM, bootstrap"
_UNKNOWN = (-inf, inf)

Interval: TypeAlias = tuple[float, float]
#: Nobody trains more pairs than this for one comparison.
MOST_PAIRS: Final = 1000


@dataclass(frozen=True)
class SceneEstimate:
    """The mean difference on one scene, from two pairs of it or more.

    Attributes:
        scene: Its name.
        center: The mean.
        wide: The 95 % interval by Student's t.
    """

    scene: str
    center: float
    wide: Interval


@dataclass(frozen=True)
class Estimate:
    """A difference with its uncertainty.

    Attributes:
        pairs: Number of pairs.
        scenes: Number of scenes that they come from.
        margin: What counts as no difference in practice.
        center: The estimate: the mean below 10 pairs, the interquartile mean from there on.
        method: Which of the two, and where the interval comes from.
        wide: The 95 % interval; it shows a difference where it excludes zero.
        narrow: The 90 % interval; it shows equivalence where it lies within the margin.
        deviation: Standard deviation of the pairs' differences; NaN for a single pair.
        p_different: Two-sided p-value of no difference.
        p_equivalent: p-value of a difference of at least the margin (two one-sided tests).
        p_above: p-value of a difference of at least the margin upwards (a one-sided test).
        needed: Pairs after which the 90 % interval is as narrow as the margin, if it gets narrower
            as usual; None where that cannot be told. More than there are where it is not so yet.
        by_scene: The scenes by themselves; empty where all pairs are of one. The interquartile
            mean leaves out a scene that is unlike the others.
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
        """Whether the 95 % interval excludes zero."""
        return self.wide[0] > 0.0 or self.wide[1] < 0.0

    @property
    def is_small(self) -> bool:
        """Whether the 90 % interval lies within the margin."""
        return -self.margin < self.narrow[0] and self.narrow[1] < self.margin


class Law(Protocol):
    """The law of an estimate: SciPy's Student's t, or a bootstrap."""

    def interval(self, level: float) -> Interval:
        """Return the two-sided interval of a level such as 0.95."""

    def cdf(self, border: float) -> float:
        """Return the p-value of an estimate of at most `border`."""

    def sf(self, border: float) -> float:
        """Return the p-value of an estimate of at least `border`."""


def estimate(differences: Sequence[float], scenes: Sequence[str], margin: float) -> Estimate:
    """Estimate a difference from pairs of runs.

    Args:
        differences: One per pair, all finite; at least one.
        scenes: The scene of each pair.
        margin: What counts as no difference in practice.
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
    """Return Student's law of the mean of two values or more."""
    from scipy.stats import t

    error = float(values.std(ddof=1)) / sqrt(len(values))
    if error == 0.0:
        return Bootstrap(values[:1], len(values) - 1)  # SciPy takes no scale of 0.
    law: Law = t(len(values) - 1, loc=values.mean(), scale=error)
    return law


def pairs_needed(deviation: float, margin: float) -> int | None:
    """Return how many pairs make the 90 % interval of a mean at most as wide as the margins.

    Args:
        deviation: Standard deviation of the pairs' differences.
        margin: The margin, above 0.

    Returns:
        The number; None if it is above 1,000.
    """
    from scipy.special import stdtrit

    pairs = np.arange(2, MOST_PAIRS + 1)
    enough = pairs[stdtrit(pairs - 1, 0.5 + NARROW / 2.0) * deviation <= margin * np.sqrt(pairs)]
    return int(enough[0]) if len(enough) else None


def _wider(narrow: Interval, pairs: int, margin: float) -> int | None:
    """Return the same for an interquartile mean, from the interval that it has with these pairs."""
    needed = pairs * ((narrow[1] - narrow[0]) / (2.0 * margin)) ** 2
    return max(2, ceil(needed)) if needed <= MOST_PAIRS else None


def _by_scene(values: NDArray[np.float64], scenes: Sequence[str]) -> tuple[SceneEstimate, ...]:
    names = np.asarray(scenes)
    of_scene = {scene: values[names == scene] for scene in dict.fromkeys(scenes)}
    return tuple(
        SceneEstimate(scene, float(own.mean()), _floats(student(own).interval(WIDE)))
        for scene, own in of_scene.items()
        if 1 < len(own) < len(values)
    )


def _floats(interval: Interval) -> Interval:
    return float(interval[0]), float(interval[1])
