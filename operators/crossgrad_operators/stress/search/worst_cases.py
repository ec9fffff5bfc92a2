"""Findings of a search for one operator in one precision."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan

import torch

from crossgrad_operators.stress.runner import UNPROVEN
from crossgrad_operators.stress.search.families import USUAL, Batch
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.verdict import NOT_FINITE, Finding

#: Cases that mutants are made from, of either kind.
POOL = 8
#: Views of these cases at most: 50 digits take long for more.
MUTATED_VIEWS = 8
#: Share of the longest gradient by which a continuous method moves at most.
JUMP = 1e-3
#: Cases that break a promise, kept for the report.
KEPT = 5


@dataclass
class WorstCases:
    """Counts and worst cases; grows with every batch.

    Attributes:
        operator: Name of the operator.
        dtype: Type of the gradients.
        matrices: Cases that were run.
        outside: Of these, cases outside the operator's set.
        usual: Cases of the family that shares are stated for.
        ordinary_outside: Of these, cases outside the set.
        unproven: Cases without a proven reference.
        not_finite: Cases with a result that is not finite.
        broken: Cases that break a promise.
        inside_pool: Cases of the largest error inside the set, the worst first.
        outside_pool: Cases of the largest |u| outside it, over the longest gradient.
        jump: The case whose result moves most where the method is continuous.
        failures: Some of the cases that break a promise, with the reason.
    """

    operator: str
    dtype: torch.dtype
    matrices: int = 0
    outside: int = 0
    usual: int = 0
    ordinary_outside: int = 0
    unproven: int = 0
    not_finite: int = 0
    broken: int = 0
    inside_pool: list[Sample] = field(default_factory=list)
    outside_pool: list[Sample] = field(default_factory=list)
    jump: Sample | None = None
    failures: list[tuple[Sample, str]] = field(default_factory=list)

    @property
    def pool(self) -> list[Sample]:
        """The cases that mutants are made from."""
        worst = [*self.inside_pool, *self.outside_pool]
        return [sample for sample in worst if len(sample.rows) <= MUTATED_VIEWS]

    @property
    def precision(self) -> str:
        """Name of the type of the gradients."""
        return str(self.dtype).removeprefix("torch.")

    @property
    def ordinary_share(self) -> float:
        """Share of usual cases outside the set."""
        return self.ordinary_outside / max(self.usual, 1)

    def add(self, batch: Batch, findings: Sequence[Finding], turn: int) -> None:
        """Counts a batch and keeps its worst cases."""
        outside = sum(finding.is_outside for finding in findings)
        self.matrices += len(findings)
        self.outside += outside
        if batch.family == USUAL:
            self.usual += len(findings)
            self.ordinary_outside += outside
        errors = [severity(finding, inside=True) for finding in findings]
        self.inside_pool = _worst(self.inside_pool, batch, errors, turn)
        ratios = [severity(finding, inside=False) for finding in findings]
        self.outside_pool = _worst(self.outside_pool, batch, ratios, turn)
        for place, finding in enumerate(findings):
            self.unproven += finding.reason == UNPROVEN
            self.not_finite += finding.reason == NOT_FINITE
            if finding.verdict == "failed" and finding.reason != UNPROVEN:
                self.fail(specimen(batch, place, turn), finding.reason)

    def fail(self, sample: Sample, reason: str) -> None:
        """Counts a case that breaks a promise; the first ones are kept for the report."""
        self.broken += 1
        if len(self.failures) < KEPT:
            self.failures.append((sample, reason))

    def jumped(self, found: Sample) -> None:
        """Counts a result that moves too much, and keeps the worst."""
        if self.jump is None or found.value > self.jump.value:
            self.jump = found
        if found.value > JUMP:
            self.broken += 1
            moved = f"moves by {found.value:.3g} of the longest gradient"
            # Before the others, which are many more and would leave no place.
            jump = (found, f"{moved} where the gradients do by 1e-12")
            self.failures = [jump, *self.failures][:KEPT]


def severity(finding: Finding, *, inside: bool) -> float:
    """The error inside the set, or |u| over the longest gradient outside; 0 if there is none."""
    if not inside:
        return finding.ratio if finding.is_outside else 0.0
    excused = finding.is_outside or finding.verdict == "undetermined"
    known = not (excused or isnan(finding.error) or finding.reason == NOT_FINITE)
    return finding.error if known else 0.0


def specimen(batch: Batch, place: int, turn: int, value: float = 0.0) -> Sample:
    """A case of a batch by itself."""
    return Sample(batch.rows[place].copy(), batch.dtype, batch.family, turn, value)


def _worst(pool: list[Sample], batch: Batch, values: Sequence[float], turn: int) -> list[Sample]:
    """The worst cases of a pool and a batch together."""
    last = pool[-1].value if len(pool) == POOL else 0.0
    ranked = sorted(range(len(values)), key=lambda place: -values[place])
    places = [place for place in ranked[:2] if values[place] > last]
    if not places:
        return pool
    found = [specimen(batch, place, turn, values[place]) for place in places]
    return sorted([*pool, *found], key=lambda each: -each.value)[:POOL]
