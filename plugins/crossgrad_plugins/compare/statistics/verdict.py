"""The three verdicts: different, equivalent within the margin, inconclusive."""

from collections.abc import Sequence
from enum import StrEnum
from math import isnan
from typing import Final

from crossgrad_plugins.compare.statistics.estimate import NARROW, WIDE, Estimate
from crossgrad_plugins.compare.statistics.holm import holm

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
    within the margin. Of more than five comparisons the p-values of either test are corrected with
    Holm's method first.
    """
    different = [each.p_different for each in family]
    equivalent = [each.p_equivalent for each in family]
    if len(family) > UNCORRECTED:
        different, equivalent = holm(different), holm(equivalent)
    return [_verdict(*each) for each in zip(different, equivalent, strict=True)]


def _verdict(p_different: float, p_equivalent: float) -> Verdict:
    if isnan(p_different):  # A single pair.
        return Verdict.INCONCLUSIVE
    if p_different < 1.0 - WIDE:
        return Verdict.DIFFERENT
    return Verdict.EQUIVALENT if p_equivalent < (1.0 - NARROW) / 2.0 else Verdict.INCONCLUSIVE
