"""Differences between two arms, pair by pair, with their verdicts."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from crossgrad_plugins.compare.arms import Problem
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.statistics import (
    Estimate,
    SceneEstimate,
    Verdict,
    estimate,
    opposed,
    verdicts,
)

#: Function that returns the value of a run, or None if the run has no value.
Reading: TypeAlias = Callable[[Run], float | None]
#: Scene and seed -> the run of an arm.
Runs: TypeAlias = Mapping[Problem, Run]


@dataclass(frozen=True)
class Pair:
    """Two runs on one scene with one seed."""

    scene: str
    seed: int
    first: float
    second: float

    @property
    def difference(self) -> float:
        """The value of the first run minus the value of the second run."""
        return self.first - self.second


@dataclass(frozen=True)
class Contrast:
    """The difference between two arms, with its uncertainty and verdict.

    Attributes:
        first: Name of the first arm.
        second: Name of the second arm.
        where: The point or the views of the comparison, such as `at the end`, or the name of a
            regime.
        quantity: The metric that is compared.
        pairs: The pairs of runs.
        estimate: The value of the first arm minus the value of the second arm; None without a pair.
        verdict: The verdict, corrected for the number of contrasts in the table.
        inside: True if runs were compared at a point before their ends.
    """

    first: str
    second: str
    where: str
    quantity: Quantity
    pairs: tuple[Pair, ...]
    estimate: Estimate | None
    verdict: Verdict = Verdict.INCONCLUSIVE
    inside: bool = False

    @property
    def ahead(self) -> int:
        """Number of pairs in which the first arm is better."""
        return sum(self.quantity.better(pair.first, pair.second) for pair in self.pairs)

    @property
    def favours(self) -> str:
        """The arm that is better by the estimate."""
        center = 0.0 if self.estimate is None else self.estimate.center
        return self.first if self.quantity.better(center, 0.0) else self.second

    @property
    def is_small(self) -> bool:
        """True if the 90 % interval is inside the margin; the verdict is not used."""
        return self.estimate is not None and self.estimate.is_small

    @property
    def differs(self) -> bool:
        """True if the 95 % interval excludes zero; other comparisons are not taken into account."""
        return self.estimate is not None and self.estimate.differs

    @property
    def opposed(self) -> tuple[SceneEstimate, ...]:
        """The scenes whose own intervals contradict the verdict."""
        if self.estimate is None:
            return ()
        return opposed(self.estimate, self.verdict, self.quantity.margin)


def contrast(
    names: tuple[str, str],
    runs: tuple[Runs, Runs],
    quantity: Quantity,
    reading: Reading,
    where: str,
) -> Contrast:
    """Compare one arm with another; pairs in which a run has no value are left out."""
    first, second = runs
    pairs = []
    for scene, seed in sorted(first.keys() & second.keys()):
        values = reading(first[scene, seed]), reading(second[scene, seed])
        if values[0] is not None and values[1] is not None:
            pairs.append(Pair(scene, seed, values[0], values[1]))
    estimated = None
    if pairs:
        differences = [pair.difference for pair in pairs]
        estimated = estimate(differences, [pair.scene for pair in pairs], quantity.margin)
    return Contrast(*names, where, quantity, tuple(pairs), estimated)


def judged(contrasts: Iterable[Contrast]) -> tuple[Contrast, ...]:
    """Return the contrasts of a table with verdicts, without contrasts that have no pair."""
    family = [row for row in contrasts if row.estimate is not None]
    judgements = verdicts([row.estimate for row in family if row.estimate is not None])
    return tuple(replace(c, verdict=verdict) for c, verdict in zip(family, judgements, strict=True))


def couples(ranking: Sequence[str], baseline: str | None) -> list[tuple[str, str]]:
    """Return the pairs of arms to compare.

    Each arm is compared with the baseline; without a baseline, with every lower-ranked arm.
    """
    if baseline is not None:
        return [(name, baseline) for name in ranking if name != baseline]
    return [(a, b) for index, a in enumerate(ranking) for b in ranking[index + 1 :]]
