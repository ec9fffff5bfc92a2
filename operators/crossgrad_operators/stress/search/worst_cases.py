"""Findings of a search for one operator and one type of gradients."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan

import torch

from crossgrad_operators.stress.runner import UNPROVEN
from crossgrad_operators.stress.search.families import USUAL, Batch
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.verdict import NOT_FINITE, Finding

#: Number of stored cases of each kind. Mutants are made from them.
POOL = 8
#: Maximum number of views of the cases from which mutants are made. Exact answers take long for
#: more views.
MUTATED_VIEWS = 8
#: Maximum change of a continuous method's result, as a share of the longest gradient.
JUMP = 1e-3
#: Number of cases with a broken guarantee that are stored for the report.
KEPT = 5


@dataclass
class WorstCases:
    """Counts and worst cases of one operator, updated with every batch.

    Attributes:
        operator: Name of the operator.
        dtype: Type of the gradients.
        matrices: Number of cases that were run.
        outside: Number of cases outside the operator's set.
        usual: Number of cases of the usual family.
        ordinary_outside: Number of usual cases outside the set.
        unproven: Number of cases without a proven reference.
        not_finite: Number of cases with a result that is not finite.
        broken: Number of cases that break a promise.
        inside_pool: Cases with the largest error inside the set, the worst first.
        outside_pool: Cases with the largest |u| outside the set, divided by the longest gradient.
        jump: The case whose result changes most although the method is continuous.
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
        """The cases from which mutants are made."""
        worst = [*self.inside_pool, *self.outside_pool]
        return [sample for sample in worst if len(sample.rows) <= MUTATED_VIEWS]

    @property
    def precision(self) -> str:
        """The name of the gradients' type."""
        return str(self.dtype).removeprefix("torch.")

    @property
    def ordinary_share(self) -> float:
        """The share of usual cases outside the set."""
        return self.ordinary_outside / max(self.usual, 1)

    def add(self, batch: Batch, findings: Sequence[Finding], turn: int) -> None:
        """Count a batch and store its worst cases."""
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
        for index, finding in enumerate(findings):
            self.unproven += finding.reason == UNPROVEN
            self.not_finite += finding.reason == NOT_FINITE
            if finding.verdict == "failed" and finding.reason != UNPROVEN:
                self.fail(specimen(batch, index, turn), finding.reason)

    def fail(self, sample: Sample, reason: str) -> None:
        """Count a case that breaks a promise. The first such cases are stored for the report."""
        self.broken += 1
        if len(self.failures) < KEPT:
            self.failures.append((sample, reason))

    def jumped(self, found: Sample) -> None:
        """Count a result that changes too much, and store the largest change."""
        if self.jump is None or found.value > self.jump.value:
            self.jump = found
        if found.value > JUMP:
            self.broken += 1
            moved = f"the result moves by {found.value:.3g} of the longest gradient"
            # Insert the case at the front, because other failures are numerous and would fill the
            # list.
            jump = (found, f"{moved} if the gradients move by 1e-12")
            self.failures = [jump, *self.failures][:KEPT]


def severity(finding: Finding, *, inside: bool) -> float:
    """Return the error inside the set, or |u| / longest gradient outside.

    Return 0 if neither is known.
    """
    if not inside:
        return finding.ratio if finding.is_outside else 0.0
    excused = finding.is_outside or finding.verdict == "undetermined"
    is_counted = not (excused or isnan(finding.error) or finding.reason == NOT_FINITE)
    return finding.error if is_counted else 0.0


def specimen(batch: Batch, place: int, turn: int, value: float = 0.0) -> Sample:
    """Return a case of a batch as a sample."""
    return Sample(batch.rows[place].copy(), batch.dtype, batch.family, turn, value)


def _worst(pool: list[Sample], batch: Batch, values: Sequence[float], turn: int) -> list[Sample]:
    """Return the worst cases of a pool and a batch together."""
    last = pool[-1].value if len(pool) == POOL else 0.0
    ranked = sorted(range(len(values)), key=lambda index: -values[index])
    worst = [index for index in ranked[:2] if values[index] > last]
    if not worst:
        return pool
    specimens = [specimen(batch, index, turn, values[index]) for index in worst]
    return sorted([*pool, *specimens], key=lambda sample: -sample.value)[:POOL]
