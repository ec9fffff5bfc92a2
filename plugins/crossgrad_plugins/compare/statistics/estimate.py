"""A difference estimated from pairs of runs, with intervals and p-values."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, nan
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.compare.statistics import student
from crossgrad_plugins.compare.statistics.bootstrap import Bootstrap
from crossgrad_plugins.compare.statistics.iqm import iqm

#: From so many pairs on the interval comes from the bootstrap.
BOOTSTRAP_FROM: Final = 10
#: Levels of the interval that shows a difference and of the one that shows equivalence.
WIDE, NARROW = 0.95, 0.90
MEAN, IQM = "mean, Student's t", "IQM, bootstrap"
_UNKNOWN = (-inf, inf)

Interval: TypeAlias = tuple[float, float]
_Found: TypeAlias = tuple[float, Interval, Interval, float, float, float, int | None]


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
    wide: Interval
    narrow: Interval
    deviation: float
    p_different: float
    p_equivalent: float
    p_above: float
    needed: int | None
    by_scene: tuple[SceneEstimate, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether the 95 % interval excludes zero."""
        return self.wide[0] > 0.0 or self.wide[1] < 0.0

    @property
    def is_small(self) -> bool:
        """Whether the 90 % interval lies within the margin."""
        return -self.margin < self.narrow[0] and self.narrow[1] < self.margin


def estimate(differences: Sequence[float], scenes: Sequence[str], margin: float) -> Estimate:
    """The estimate from differences of pairs.

    Args:
        differences: One per pair, all finite; at least one.
        scenes: The scene of each pair.
        margin: What counts as no difference in practice.
    """
    values = np.asarray(differences, dtype=np.float64)
    enough = len(values) >= BOOTSTRAP_FROM
    found = _by_bootstrap(values, scenes, margin) if enough else _by_student(values, margin)
    center, wide, narrow, different, equivalent, above, needed = found
    return Estimate(
        pairs=len(values),
        scenes=len(set(scenes)),
        margin=margin,
        center=center,
        method=IQM if enough else MEAN,
        wide=wide,
        narrow=narrow,
        deviation=_deviation(values),
        p_different=different,
        p_equivalent=equivalent,
        p_above=above,
        needed=needed,
        by_scene=_by_scene(values, scenes),
    )


def _by_scene(values: NDArray[np.float64], scenes: Sequence[str]) -> tuple[SceneEstimate, ...]:
    names = np.asarray(scenes)
    found = []
    for scene in dict.fromkeys(scenes):
        own = values[names == scene]
        if 1 < len(own) < len(values):
            law = student.Law.of(own)
            found.append(SceneEstimate(scene, law.center, law.interval(WIDE)))
    return tuple(found)


def _deviation(values: NDArray[np.float64]) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else nan


def _by_student(values: NDArray[np.float64], margin: float) -> _Found:
    center, noise = float(values.mean()), _deviation(values)
    if len(values) == 1:
        return center, _UNKNOWN, _UNKNOWN, nan, nan, nan, None
    law = student.Law.of(values)
    above = law.upper_tail(margin)
    equivalent = max(above, law.lower_tail(-margin))
    different = min(1.0, 2.0 * min(law.upper_tail(0.0), law.lower_tail(0.0)))
    needed = student.pairs_needed(noise, margin)
    return center, law.interval(WIDE), law.interval(NARROW), different, equivalent, above, needed


def _by_bootstrap(values: NDArray[np.float64], scenes: Sequence[str], margin: float) -> _Found:
    law = Bootstrap.of(values, scenes)
    above = law.upper_tail(margin)
    equivalent = max(above, law.lower_tail(-margin))
    different = min(1.0, 2.0 * min(law.upper_tail(0.0), law.lower_tail(0.0)))
    wide, narrow = law.interval(WIDE), law.interval(NARROW)
    # The interquartile mean has an interval of another width than the mean, and fewer degrees of
    # freedom: its own one tells how many pairs make it narrow enough.
    pairs = len(values) * ((narrow[1] - narrow[0]) / (2.0 * margin)) ** 2
    needed = max(2, ceil(pairs)) if pairs <= student.MOST_PAIRS else None
    return float(iqm(values)), wide, narrow, different, equivalent, above, needed
