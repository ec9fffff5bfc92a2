"""Compare the error of a result with the guarantee, and return a verdict."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf, isnan, nan, sqrt
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from crossgrad_operators.stress.cases import Case, Rows
from crossgrad_operators.stress.exact import (
    Matrix,
    exact_gramian,
    finite_views,
    weighted_sum,
)
from crossgrad_operators.stress.oracles import cosines, lengths
from crossgrad_operators.stress.promises import ALL, Facts, Promise
from crossgrad_operators.stress.reference import Answer

#: If kappa u is above this value, the gradients do not determine the result. For a larger kappa u,
#: only a finite result is guaranteed.
UNDETERMINED: Final = 0.1
#: Reason of a failure if a result contains NaN or infinity.
NOT_FINITE: Final = "not finite"

Verdict = Literal["ok", "undetermined", "outside", "refused", "failed"]

#: Function that returns the distance from a result to the nearest result that a rule for elements
#: allows.
ElementRule = Callable[[Case, Tensor], float]


@dataclass(frozen=True)
class Finding:
    """The verdict on one result.

    Attributes:
        verdict: `ok`, `undetermined` (kappa u > 0.1, result finite), `outside`, `refused` (K is not
            supported) or `failed`. The verdict `outside` means: outside the set with a guaranteed
            accuracy, finite, and not too long.
        error: Relative error in units of u kappa; NaN without a reference.
        reason: Reason of the failure; empty without a failure.
        ratio: Length |u| of the result, divided by the longest gradient; NaN inside the set.
    """

    verdict: Verdict
    error: float = nan
    reason: str = ""
    ratio: float = nan

    @property
    def is_outside(self) -> bool:
        """True if the gradients are outside the set for which an accuracy is guaranteed."""
        return not isnan(self.ratio)

    @property
    def severity(self) -> tuple[int, float]:
        """Sort key by which the worst of several findings is found."""
        order = ("ok", "outside", "undetermined", "refused", "failed")
        return order.index(self.verdict), self.error


class ExactCase:
    """A case with its exact Gramian, which is computed once for all operators."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.finite = finite_views(case)
        self.gramian: Matrix = exact_gramian(case)

    @property
    def touched(self) -> bool:
        """True if at least one view has a finite gradient."""
        return any(f and k not in self.case.absent for k, f in enumerate(self.finite))


def judge(
    exact: ExactCase,
    found: Tensor | None,
    expected: Answer | ElementRule | None,
    promise: Promise = ALL,
) -> Finding:
    """Compare a result with exact weights or with a rule for elements.

    If neither is available, check only that the result is finite.
    """
    if found is None or not exact.touched:
        return _either(
            found is None and not exact.touched, "None is expected only for blocks without any view"
        )
    if not bool(torch.isfinite(found).all()):
        return Finding("failed", inf, NOT_FINITE)
    if expected is None:
        return Finding("ok")
    if not isinstance(expected, Answer):
        return by_law(exact, found, expected(exact.case, found), promise)
    return _against(exact, found, expected, promise)


def by_law(exact: ExactCase, found: Tensor, error: float, promise: Promise = ALL) -> Finding:
    """Check a result by its distance from the nearest result that a rule or a law allows."""
    longest = sqrt(float(max(exact.gramian[k][k] for k in range(exact.case.views))))
    scale = max(longest, float(found.double().norm()))
    return _measured(exact.case, error, (scale, scale), promise.bound(facts_of(exact)))


def _against(exact: ExactCase, found: Tensor, expected: Answer, promise: Promise) -> Finding:
    facts = facts_of(exact, expected)
    if not promise.inside(facts):
        return _outside(exact.case, found, facts, promise)
    if all(w == 0 for w in expected.weights):
        return _either(not bool(found.any()), "must be exactly zero")
    sizes = float(max(expected.largest, expected.length)), float(expected.length)
    return _measured(exact.case, distance(exact.case, found, expected), sizes, promise.bound(facts))


def facts_of(exact: ExactCase, answer: Answer | None = None) -> Facts:
    """Return the quantities that define the sets.

    Without an answer, the weights and the length are zero.
    """
    gramian = exact.gramian
    places = [k for k in range(exact.case.views) if gramian[k][k] > 0]
    reduced_gramian = [[gramian[i][j] for j in places] for i in places]
    return Facts(
        norms=np.array([float(n) for n in lengths(reduced_gramian)]),
        cosines=cosines(reduced_gramian),
        weights=np.array([float(answer.weights[k]) if answer else 0.0 for k in places]),
        length=float(answer.length) if answer else 0.0,
        unit=_unit(exact.case),
    )


def _unit(case: Case) -> float:
    return float(torch.finfo(case.dtype).eps) / 2


def _either(right: bool, otherwise: str) -> Finding:
    return Finding("ok", 0.0) if right else Finding("failed", inf, otherwise)


def _outside(case: Case, found: Tensor, facts: Facts, promise: Promise) -> Finding:
    ratio = float(found.double().norm()) / facts.longest
    if ratio <= promise.factor(case.views):
        return Finding("outside", ratio=ratio)
    return Finding(
        "failed",
        inf,
        f"{ratio:.3g} times as long as the longest gradient, outside the operator's set",
        ratio,
    )


def _measured(case: Case, error: float, sizes: tuple[float, float], bound: float) -> Finding:
    unit, (scale, length) = _unit(case), sizes
    # Gradual underflow causes an absolute error in each element. Subtract this error.
    lost = sqrt(case.size) * float(torch.finfo(case.dtype).smallest_normal) * unit
    error = max(error - lost, 0.0)
    measured = error / (unit * scale) if error else 0.0
    if measured <= bound:
        return Finding("ok", measured)
    if unit * scale > UNDETERMINED * length:
        return Finding("undetermined", measured)
    return Finding("failed", measured, f"error {measured:.3g} u kappa")


def distance(case: Case, found: Tensor, expected: Answer) -> float:
    """Return the distance |u - u*| between a result and the exact result.

    The head is compared with 50 digits, the pattern in float64.
    """
    values = found.detach().double().numpy()
    head = case.head.shape[1]
    exact = weighted_sum(expected.weights, case.exact_head)
    # Subtract with 50 digits, because leading digits cancel. After the subtraction, float64 is
    # accurate enough.
    parts = [float(e - v) for v, e in zip(values[:head].tolist(), exact, strict=True)]
    if case.copies:
        pattern = np.array([float(v) for v in weighted_sum(expected.weights, case.exact_pattern)])
        repeated = values[head:].reshape(case.copies, -1)
        pieces = np.array_split(repeated, max(1, case.copies // 1000))
        parts += [float(np.linalg.norm(rows - pattern)) for rows in pieces]
    return hypot(*parts)


def one_sign(case: Case, found: Tensor) -> float:
    """Return the distance to the nearest sums of elements with equal sign, as in GradDrop."""
    values = found.detach().double().numpy()
    head = case.head.shape[1]
    parts = [_to_nearest_sign(case.exact_head, values[None, :head])]
    if case.copies:
        repeated = values[head:].reshape(case.copies, -1)
        pieces = np.array_split(repeated, max(1, case.copies // 1000))
        parts += [_to_nearest_sign(case.exact_pattern, piece) for piece in pieces]
    return hypot(*parts)


def _to_nearest_sign(rows: Rows, values: Rows) -> float:
    finite = rows[np.isfinite(rows).all(axis=1)]
    positive, negative = finite.clip(min=0).sum(axis=0), finite.clip(max=0).sum(axis=0)
    return float(np.linalg.norm(np.minimum(abs(values - positive), abs(values - negative))))
