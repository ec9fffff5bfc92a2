"""The three verdicts: different, equivalent within the margin, inconclusive."""

from collections.abc import Sequence
from enum import StrEnum
from math import isnan
from typing import Final

from crossgrad_plugins.compare.statistics.estimate import NARROW, WIDE, Estimate, SceneEstimate

#: Up to so many comparisons are judged one by one.
UNCORRECTED: Final = 5


class Verdict(StrEnum):
    """The verdict on a difference."""

    DIFFERENT = "different"
    EQUIVALENT = "equivalent"
    INCONCLUSIVE = "inconclusive"


def verdicts(family: Sequence[Estimate]) -> list[Verdict]:
    """The verdict on each of the comparisons that are shown together.

    Different where the 95 % interval excludes zero, else equivalent where the 90 % interval lies
    within the margin. Of more than five comparisons it takes the p-values of either test, corrected
    with Holm's method, too.
    """
    if len(family) <= UNCORRECTED:
        return [_verdict(each.differs, each.is_small) for each in family]
    different = corrected([each.p_different for each in family])
    equivalent = corrected([each.p_equivalent for each in family])
    return [
        _verdict(each.differs and p < 1.0 - WIDE, each.is_small and q < (1.0 - NARROW) / 2.0)
        for each, p, q in zip(family, different, equivalent, strict=True)
    ]


def corrected(values: Sequence[float]) -> list[float]:
    """The p-values of one test of comparisons that are shown together: Holm's above five."""
    return holm(values) if len(values) > UNCORRECTED else list(values)


def holm(values: Sequence[float]) -> list[float]:
    """Return p-values adjusted by Holm's method (Scandinavian Journal of Statistics 6, 1979).

    NaN is the p-value of a test that was not made: it stays NaN and is not counted.
    """
    known = sorted((value, index) for index, value in enumerate(values) if not isnan(value))
    adjusted, largest = list(values), 0.0
    for rank, (value, index) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * value))
        adjusted[index] = largest
    return adjusted


def opposed(found: Estimate, verdict: Verdict, margin: float) -> tuple[SceneEstimate, ...]:
    """The scenes that surely contradict a verdict on all of them, by their own 95 % intervals.

    Of a difference those that differ the other way, of equivalence those beyond the margin.
    """
    if verdict is Verdict.INCONCLUSIVE:
        return ()
    sign = 1.0 if found.center > 0.0 else -1.0
    return tuple(
        each
        for each in found.by_scene
        if (
            max(sign * limit for limit in each.wide) < 0.0
            if verdict is Verdict.DIFFERENT
            else each.wide[0] > margin or each.wide[1] < -margin
        )
    )


def _verdict(differs: bool, is_small: bool) -> Verdict:
    if differs:
        return Verdict.DIFFERENT
    return Verdict.EQUIVALENT if is_small else Verdict.INCONCLUSIVE
