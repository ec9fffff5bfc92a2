"""Run one operator on one test case, and check the result."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, cast

import numpy as np
from torch import Tensor

from crossgrad_core.commands import gathered
from crossgrad_core.plugin import (
    EMPTY_STATE,
    AggregateContext,
    Block,
    LearningRate,
    Operator,
    PluginState,
)
from crossgrad_operators.stress.cases import Case
from crossgrad_operators.stress.oracles import Oracle
from crossgrad_operators.stress.promises import ALL, Promise
from crossgrad_operators.stress.reference import Answer, Views, answer, sample_views
from crossgrad_operators.stress.solvers import UnprovenError
from crossgrad_operators.stress.verdict import ElementRule, ExactCase, Finding, judge

#: The only block of a test case.
BLOCK = Block("means", ("means",), False, "geometry", LearningRate(1.0))
#: To measure the time, a case with at most this number of elements is repeated.
REPEATED = 100_000
#: Number of steps for operators that store values between steps.
STEPS = 3
#: Reason of a failure if the oracle could not prove its result.
UNPROVEN = "the reference is not proven"


@dataclass(frozen=True)
class Cell:
    """The result of one operator on one case, or for one law.

    A law is a property that every operator must have.

    Attributes:
        operator: Name of the operator.
        case: Name of the case.
        finding: The worst finding over all steps.
        microseconds: Time of one aggregation in microseconds, including Gramians and the weighted
            sum.
    """

    operator: str
    case: str
    finding: Finding
    microseconds: float = float("nan")


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference with which the results of an operator are compared.

    Attributes:
        oracle: Function that returns exact weights; None without an oracle.
        options: Options of the operator, which the oracle receives.
        rule: Rule for single elements, for an operator that works on elements.
        promise: The set for which an accuracy is guaranteed, and the bounds outside the set.
    """

    oracle: Oracle | None
    options: Mapping[str, Any]
    rule: ElementRule | None = None
    promise: Promise = ALL


def run_case(name: str, operator: Operator, exact: ExactCase, reference: Reference) -> Cell:
    """Run an operator on a case and check every result.

    An operator that stores values runs for several steps.
    """
    case = exact.case
    if not operator.views.admits(case.views):
        return Cell(name, case.name, Finding("refused"))
    finding, times = judged(operator, exact, reference)
    if times and case.size <= REPEATED:
        times += [timed(operator, case, sample_views(case.views))[2] for _ in range(3)]
    return Cell(name, case.name, finding, 1e6 * min(times, default=float("nan")))


def judged(
    operator: Operator,
    exact: ExactCase,
    reference: Reference,
    views_of: Callable[[int, int], Views] = sample_views,
) -> tuple[Finding, list[float]]:
    """Return the worst finding over all steps, and the seconds of each step.

    After a failure, the list of seconds is empty.

    Args:
        operator: The operator to check.
        exact: The test case.
        reference: The reference for the operator's results.
        views_of: Function from (K, step) to the properties of the views.
    """
    state = EMPTY_STATE
    memory: dict[Any, Any] = {}
    findings, times = [], []
    for step in range(STEPS):
        views = views_of(exact.case.views, step)
        try:
            result, state, seconds = timed(operator, exact.case, views, state)
        except Exception as error:
            # An operator of another package may raise any exception.
            return Finding("failed", reason=f"{type(error).__name__}: {error}"), []
        times.append(seconds)
        finding = compared(exact, result, reference, views, memory)
        if finding.reason == UNPROVEN:
            return finding, []
        findings.append(finding)
        if not (state.values or state.tensors or state.per_primitive):
            break
    return max(findings, key=lambda finding: finding.severity), times


def compared(
    exact: ExactCase,
    found: Tensor | None,
    reference: Reference,
    views: Views,
    memory: dict[Any, Any],
) -> Finding:
    """Compare a result with its reference.

    `memory` contains the values that the oracle stores. The stored values may change in this call.
    """
    expected: Answer | ElementRule | None = reference.rule
    try:
        if reference.oracle is not None:
            expected = answer(reference.oracle, exact.gramian, views, memory, reference.options)
        return judge(exact, found, expected, reference.promise)
    except UnprovenError:
        return Finding("failed", reason=UNPROVEN)


def timed(
    operator: Operator, case: Case, views: Views, state: PluginState = EMPTY_STATE
) -> tuple[Tensor | None, PluginState, float]:
    """Return the aggregated gradient of a case, the new state of the operator, and the seconds."""
    gradients = [{BLOCK.name: gradient} for gradient in case.gradients()]
    context = context_of(gradients, (BLOCK,), views)
    start = perf_counter()
    aggregated, state = operator.aggregate(context, state)
    return aggregated.gradients[BLOCK.name], state, perf_counter() - start


def context_of(
    gradients: Sequence[Mapping[str, Tensor | None]], blocks: tuple[Block, ...], views: Views
) -> AggregateContext:
    """Return the context for an aggregation. The scene and the schedule are None."""
    return AggregateContext(
        step=1,
        schedule=cast("Any", None),
        scene=cast("Any", None),
        states={},
        rng=np.random.default_rng(views.seed),
        gradients=gathered(gradients, blocks),
        losses=np.ones(len(views.labels)),
        labels=views.labels,
        distances=np.array(views.ratios),
        reference_distance=1.0,
        blocks=blocks,
    )
