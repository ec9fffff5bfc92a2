"""The results of a search for one operator and one type of gradients."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan

import torch

from crossgrad_operators.stress.runner import UNPROVEN
from crossgrad_operators.stress.search.families import USUAL, Batch
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.verdict import NOT_FINITE, Finding

#: Number of worst cases that are stored inside and outside the set. Mutants are made from the
#: stored cases.
POOL = 8
#: Largest number of views of cases from which mutants are made. With more views, exact results
#: would take too long.
MUTATED_VIEWS = 8
#: Largest allowed change of a result, relative to the longest gradient, where the operator is
#: continuous.
JUMP = 1e-3
#: Number of stored cases that break a guarantee, for the report.
KEPT = 5


@dataclass
class WorstCases:
    """Counts and worst cases of one operator. Every batch updates these counts and cases.

    Attributes:
        operator: Name of the operator.
        dtype: Type of the gradients.
        matrices: Number of tested cases.
        outside: Number of cases outside the operator's set.
        usual: Number of cases of the family `USUAL`.
        ordinary_outside: Number of cases of the family `USUAL` outside the set.
        unproven: Number of cases for which the oracle could not prove its result.
        not_finite: Number of cases whose result is not finite.
        broken: Number of cases that break a guarantee.
        inside_pool: The cases with the largest errors inside the set, in descending order.
        outside_pool: The cases with the longest results outside the set, relative to the longest
            gradient.
        jump: The case whose result changes most although the operator is continuous.
        failures: Some of the cases that break a guarantee, with the reasons.
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
        """The stored cases from which mutants are made."""
        worst = [*self.inside_pool, *self.outside_pool]
        return [sample for sample in worst if len(sample.rows) <= MUTATED_VIEWS]

    @property
    def precision(self) -> str:
        """The name of the gradients' type."""
        return str(self.dtype).removeprefix("torch.")

    @property
    def ordinary_share(self) -> float:
        """Share of the cases of the family `USUAL` that are outside the set."""
        return self.ordinary_outside / max(self.usual, 1)

    def add(self, batch: Batch, findings: Sequence[Finding], turn: int) -> None:
        """Count the cases of a batch, and store its worst cases."""
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
        """Count a case that breaks a guarantee.

        The first few failed cases are stored for the report.
        """
        self.broken += 1
        if len(self.failures) < KEPT:
            self.failures.append((sample, reason))

    def jumped(self, found: Sample) -> None:
        """Count a case whose result changes too much. Store the case with the largest change."""
        if self.jump is None or found.value > self.jump.value:
            self.jump = found
        if found.value > JUMP:
            self.broken += 1
            moved = f"the result moves by {found.value:.3g} of the longest gradient"
            # Insert this case at the front, because many other failures could fill the list.
            jump = (found, f"{moved} if the gradients move by 1e-12")
            self.failures = [jump, *self.failures][:KEPT]


def severity(finding: Finding, *, inside: bool) -> float:
    """Return the error inside the set, or the length |u| / (longest gradient) outside the set.

    Return 0 if the requested value is not known.
    """
    if not inside:
        return finding.ratio if finding.is_outside else 0.0
    excused = finding.is_outside or finding.verdict == "undetermined"
    is_counted = not (excused or isnan(finding.error) or finding.reason == NOT_FINITE)
    return finding.error if is_counted else 0.0


def specimen(batch: Batch, place: int, turn: int, value: float = 0.0) -> Sample:
    """Return one case of a batch as a `Sample`."""
    return Sample(batch.rows[place].copy(), batch.dtype, batch.family, turn, value)


def _worst(pool: list[Sample], batch: Batch, values: Sequence[float], turn: int) -> list[Sample]:
    """Return the worst cases among the cases of a pool and of a batch."""
    last = pool[-1].value if len(pool) == POOL else 0.0
    ranked = sorted(range(len(values)), key=lambda index: -values[index])
    worst = [index for index in ranked[:2] if values[index] > last]
    if not worst:
        return pool
    specimens = [specimen(batch, index, turn, values[index]) for index in worst]
    return sorted([*pool, *specimens], key=lambda sample: -sample.value)[:POOL]
