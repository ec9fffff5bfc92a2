"""Check the results of an operator on a batch of cases."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_operators.stress.cases import short
from crossgrad_operators.stress.reference import Views
from crossgrad_operators.stress.runner import compared
from crossgrad_operators.stress.search.families import USUAL, Batch, results, search_views
from crossgrad_operators.stress.solvers import UnprovenError
from crossgrad_operators.stress.suite import Subject
from crossgrad_operators.stress.verdict import ExactCase, Finding, by_law, facts_of

Floats = NDArray[np.float64]

#: Factor for gradients, a power of two. If the gradients are multiplied by this factor, the results
#: must be multiplied by this factor, too.
_SCALE: Final = 2.0**20
#: Relative change of gradients. Results must change only a little.
_NUDGE: Final = 1e-12
#: Number of cases with the largest changes for which continuity is tested with 50 digits.
_CANDIDATES: Final = 16


def examine(subject: Subject, batch: Batch) -> list[Finding]:
    """Run an operator on a batch, and check every result."""
    with np.errstate(all="ignore"):
        outputs = results(subject.operator, batch)
        return [
            _judged(subject, exact_case(batch, index), torch.from_numpy(outputs[index]), apart)
            for index, apart in enumerate(_from_laws(subject, batch, outputs))
        ]


def _judged(subject: Subject, exact: ExactCase, result: Tensor, apart: float | None) -> Finding:
    views = search_views(exact.case.views)
    finding = compared(exact, result, subject.reference, views, {})
    if apart is None or finding.verdict != "ok":
        return finding
    return by_law(exact, result, apart)


def exact_case(batch: Batch, place: int) -> ExactCase:
    """Return one case of a batch, together with its exact Gramian."""
    return ExactCase(short(batch.family, batch.rows[place], batch.dtype))


def _from_laws(subject: Subject, batch: Batch, outputs: Floats) -> list[float] | list[None]:
    """Return the errors [B] for two laws: scaling of the gradients, and exchange of two views.

    For an operator with a reference, all errors are None.
    """
    if subject.reference.oracle is not None or subject.reference.rule is not None:
        return [None] * len(outputs)
    views = search_views(batch.views)
    scaled = results(subject.operator, replace(batch, rows=batch.rows * _SCALE), views) / _SCALE
    apart = np.linalg.norm(scaled - outputs, axis=1)
    # The exchange of two views is tested only for random gradients. If a Gramian is nearly
    # singular, the order of the views may matter. Gramians of random gradients are far from
    # singular.
    if batch.family == USUAL and batch.views == 2:  # noqa: PLR2004
        turned = Views(views.labels[::-1], views.ratios[::-1], views.seed)
        other = results(subject.operator, replace(batch, rows=batch.rows[:, ::-1]), turned)
        apart = np.maximum(apart, np.linalg.norm(other - outputs, axis=1))
    return [float(distance) for distance in apart]


def largest_jump(
    subject: Subject, batch: Batch, rng: np.random.Generator
) -> tuple[int, float] | None:
    """Return the case whose result changes most after a relative change of 1e-12 in its gradients.

    Also return the largest change.

    The change is divided by the length of the longest gradient. Cases in which the operator is not
    continuous are skipped. If all candidates are skipped, the function returns None. The gradients
    are converted to float64, in which a change of 1e-12 is represented accurately.
    """
    wide = replace(batch, dtype=torch.float64)
    noise = _NUDGE * rng.standard_normal(batch.rows.shape)
    moved = replace(wide, rows=batch.rows * (1 + noise))
    with np.errstate(all="ignore"):
        gap = results(subject.operator, moved) - results(subject.operator, wide)
        jump = np.linalg.norm(gap, axis=1) / np.linalg.norm(batch.rows, axis=2).max(axis=1)
    jump = np.where(np.isfinite(jump), jump, 0.0)
    for index in np.argsort(-jump)[:_CANDIDATES].tolist():
        if _is_continuous(subject, exact_case(wide, index)):
            return index, float(jump[index])
    return None


def _is_continuous(subject: Subject, exact: ExactCase) -> bool:
    try:
        return subject.promise.continuous(facts_of(exact))
    except UnprovenError:
        return False
