"""Runs one operator on one case and judges what comes out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot, inf, sqrt
from time import perf_counter
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.blocks import Block, LearningRate
from crossgrad_core.contexts import AggregateContext, Aggregated
from crossgrad_core.dense_gradients import DenseViewGradients
from crossgrad_core.operator import Operator
from crossgrad_core.state import EMPTY_STATE, PluginState
from crossgrad_core.stress.case import Case
from crossgrad_core.stress.exact import Matrix, exact_gramian, finite_views, weighted_sum
from crossgrad_core.stress.oracles import Oracle
from crossgrad_core.stress.reference import Answer, Views, answer, usual_views
from crossgrad_core.stress.solvers import UnprovenError

#: The one block of a case.
BLOCK = Block("means", ("means",), False, "geometry", LearningRate(1.0))
#: Relative error that is promised, in units of u kappa.
PROMISED = 8.0
#: From kappa u on only finiteness is promised: the input does not determine the result any better.
UNDETERMINED = 0.1
#: Elements up to which a case is repeated for its time.
REPEATED = 100_000
#: Steps that operators with a memory are run for.
STEPS = 3

Verdict = Literal["ok", "undetermined", "refused", "failed"]


@dataclass(frozen=True)
class Cell:
    """One operator on one case.

    Attributes:
        operator: Name of the operator.
        case: Name of the case.
        verdict: `ok`; `undetermined`: kappa u > 0.1 and finite; `refused`: K is not admitted;
            `failed`.
        error: Relative error in units of u kappa (8 is promised); NaN without a reference.
        microseconds: Time of one aggregation, Gramians and weighted sum included.
        reason: Why it failed.
    """

    operator: str
    case: str
    verdict: Verdict
    error: float = float("nan")
    microseconds: float = float("nan")
    reason: str = ""


class ExactCase:
    """A case with its exact Gramian, worked out once for all operators."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.finite = finite_views(case)
        self.gramian: Matrix = exact_gramian(case)


def judge(
    name: str,
    operator: Operator,
    exact: ExactCase,
    oracle: Oracle | None,
    options: Mapping[str, Any],
) -> Cell:
    """Runs an operator (a few steps, if it remembers) and compares each result with the oracle's."""
    case = exact.case
    if not operator.views.admits(case.views):
        return Cell(name, case.name, "refused")
    state, memory = EMPTY_STATE, {}  # type: PluginState, dict[Any, Any]
    worst = Cell(name, case.name, "ok", 0.0)
    times = []
    for step in range(STEPS):
        views = usual_views(case.views, seed=step)
        start = perf_counter()
        try:
            found, state = aggregate(operator, case, views, state, step)
        except Exception as error:
            # Third-party code may raise anything.
            return Cell(name, case.name, "failed", reason=f"{type(error).__name__}: {error}")
        times.append(perf_counter() - start)
        expected = None
        if oracle is not None:
            try:
                expected = answer(oracle, exact.gramian, views, memory, options)
            except UnprovenError:
                return Cell(name, case.name, "failed", reason="the reference is not proven")
        cell = _judged(name, exact, found.gradients[BLOCK.name], expected)
        worst = max(worst, cell, key=_severity)
        if not (state.values or state.tensors or state.per_primitive):
            break
    times += _more_times(operator, case)
    return Cell(name, case.name, worst.verdict, worst.error, 1e6 * min(times), worst.reason)


def aggregate(
    operator: Operator, case: Case, views: Views, state: PluginState, step: int
) -> tuple[Aggregated, PluginState]:
    """What the operator makes of the gradients of a case."""
    gradients = [{BLOCK.name: g} for g in case.gradients()]
    return operator.aggregate(context_of(gradients, (BLOCK,), views, step), state)


def context_of(
    gradients: Sequence[Mapping[str, Tensor | None]],
    blocks: tuple[Block, ...],
    views: Views,
    step: int = 0,
) -> AggregateContext:
    """What the seam is offered; no operator may need the scene or the schedule."""
    return AggregateContext(
        step=step + 1,
        schedule=cast("Any", None),
        scene=cast("Any", None),
        states={},
        rng=np.random.default_rng(views.seed),
        gradients=DenseViewGradients(gradients, blocks),
        losses=np.ones(len(views.labels)),
        labels=views.labels,
        distances=np.array(views.ratios),
        reference_distance=1.0,
        blocks=blocks,
    )


def _more_times(operator: Operator, case: Case) -> list[float]:
    if case.size > REPEATED:
        return []
    times = []
    views = usual_views(case.views)
    gradients = [{BLOCK.name: g} for g in case.gradients()]
    for _ in range(3):
        context = context_of(gradients, (BLOCK,), views)
        start = perf_counter()
        operator.aggregate(context, EMPTY_STATE)
        times.append(perf_counter() - start)
    return times


def _severity(cell: Cell) -> tuple[int, float]:
    return ("ok", "undetermined", "refused", "failed").index(cell.verdict), cell.error


def _judged(name: str, exact: ExactCase, found: Tensor | None, expected: Answer | None) -> Cell:
    case = exact.case
    touched = [k for k in range(case.views) if k not in case.absent and exact.finite[k]]
    if found is None or not touched:
        if (found is None) == (not touched):
            return Cell(name, case.name, "ok", 0.0)
        return Cell(name, case.name, "failed", inf, reason="None must mean that no view counts")
    if not bool(torch.isfinite(found).all()):
        return Cell(name, case.name, "failed", inf, reason="not finite")
    if expected is None:
        return Cell(name, case.name, "ok")
    return _compared(name, case, found, expected)


def _compared(name: str, case: Case, found: Tensor, expected: Answer) -> Cell:
    if all(w == 0 for w in expected.weights):
        exactly = not bool(found.any())
        reason = "" if exactly else "must be exactly zero"
        return Cell(
            name, case.name, "ok" if exactly else "failed", 0.0 if exactly else inf, reason=reason
        )
    unit = float(torch.finfo(case.dtype).eps) / 2
    # What gradual underflow takes from every element cannot be relative.
    lost = sqrt(case.size) * float(torch.finfo(case.dtype).smallest_normal) * unit
    error = max(_distance(case, found, expected) - lost, 0.0)
    scale = float(max(expected.largest, expected.length))
    measured = error / (unit * scale)
    if measured <= PROMISED:
        return Cell(name, case.name, "ok", measured)
    if unit * scale > UNDETERMINED * float(expected.length):
        return Cell(name, case.name, "undetermined", measured)
    reason = f"error {measured:.3g} u kappa"
    return Cell(name, case.name, "failed", measured, reason=reason)


def _distance(case: Case, found: Tensor, expected: Answer) -> float:
    """|u - u*|: in 50 digits for the head, by its closed form for the repeated pattern."""
    values = found.detach().double().numpy()
    head = case.head.shape[1]
    exact = weighted_sum(expected.weights, case.exact_head)
    # Subtracted in 50 digits; the differences then need few.
    parts = [float(e - v) for v, e in zip(values[:head].tolist(), exact, strict=True)]
    if case.copies:
        pattern = np.array([float(v) for v in weighted_sum(expected.weights, case.exact_pattern)])
        repeated = values[head:].reshape(case.copies, -1)
        pieces = np.array_split(repeated, max(1, case.copies // 1000))
        parts += [float(np.linalg.norm(rows - pattern)) for rows in pieces]
    return hypot(*parts)
