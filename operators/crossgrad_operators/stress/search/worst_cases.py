"""Findings of a search for one operator in one precision."""

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_operators.stress.search.batch import Batch
from crossgrad_operators.stress.search.examine import Examined
from crossgrad_operators.stress.search.families import USUAL
from crossgrad_operators.stress.search.samples import Sample

#: Cases that mutants are made from, of either kind.
POOL = 8
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
        usual_outside: Of these, cases outside the set.
        unproven: Cases without a proven reference.
        not_finite: Cases with a result that is not finite.
        broken: Cases that break a promise.
        sampled: Cases that were also held against 50 digits.
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
    usual_outside: int = 0
    unproven: int = 0
    not_finite: int = 0
    broken: int = 0
    sampled: int = 0
    inside_pool: list[Sample] = field(default_factory=list)
    outside_pool: list[Sample] = field(default_factory=list)
    jump: Sample | None = None
    failures: list[tuple[Sample, str]] = field(default_factory=list)

    @property
    def pool(self) -> list[Sample]:
        """What mutants are made from."""
        return [*self.inside_pool, *self.outside_pool]

    @property
    def precision(self) -> str:
        """Name of the type of the gradients."""
        return str(self.dtype).removeprefix("torch.")

    @property
    def usual_share(self) -> float:
        """Share of usual cases outside the set."""
        return self.usual_outside / max(self.usual, 1)

    def add(self, examined: Examined, turn: int) -> None:
        """Counts a batch and keeps its worst cases."""
        outside = ~examined.inside
        self.matrices += len(outside)
        self.outside += int(outside.sum())
        if examined.batch.family == USUAL:
            self.usual += len(outside)
            self.usual_outside += int(outside.sum())
        self.unproven += int((examined.finite & ~examined.known).sum())
        self.not_finite += int((~examined.finite).sum())
        self.broken += int(examined.broken.sum())
        inside_error = np.where(examined.inside & examined.finite, examined.error, 0.0)
        self.inside_pool = _worst(self.inside_pool, examined, inside_error, turn)
        ratio = np.where(outside & examined.finite, examined.ratio, 0.0)
        self.outside_pool = _worst(self.outside_pool, examined, ratio, turn)
        for place in np.flatnonzero(examined.broken)[: KEPT - len(self.failures)]:
            self.failures.append((specimen(examined, place, turn), _reason(examined, place)))

    def jumped(self, batch: Batch, jumps: NDArray[np.float64], turn: int) -> None:
        """Counts results that move too much, and keeps the worst."""
        place = int(np.argmax(jumps))
        value = float(jumps[place])
        found = Sample(batch.rows[place].copy(), batch.dtype, batch.family, turn, value)
        if self.jump is None or value > self.jump.value:
            self.jump = found
        if value > JUMP:
            self.broken += int((jumps > JUMP).sum())
            reason = f"moves by {value:.3g} of the longest gradient where the gradients do by 1e-12"
            # Before the others, which are many more and would leave no place.
            self.failures = [(found, reason), *self.failures][:KEPT]


def specimen(examined: Examined, place: int, turn: int, value: float = 0.0) -> Sample:
    """A case of a batch by itself."""
    batch = examined.batch
    return Sample(batch.rows[place].copy(), batch.dtype, batch.family, turn, value)


def _worst(
    pool: list[Sample], examined: Examined, values: NDArray[np.float64], turn: int
) -> list[Sample]:
    """The worst cases of a pool and a batch together."""
    last = pool[-1].value if len(pool) == POOL else 0.0
    places = [int(i) for i in np.argsort(-values, kind="stable")[:2] if values[i] > last]
    if not places:
        return pool
    found = [specimen(examined, place, turn, float(values[place])) for place in places]
    return sorted([*pool, *found], key=lambda each: -each.value)[:POOL]


def _reason(examined: Examined, place: int) -> str:
    if not examined.finite[place]:
        return "not finite"
    if examined.inside[place]:
        return f"error {examined.error[place]:.3g} u kappa inside the set"
    return f"{examined.ratio[place]:.3g} times the longest gradient outside the set"
