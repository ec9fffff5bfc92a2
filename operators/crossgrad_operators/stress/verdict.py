"""Whether a result is as close to the exact one as promised."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf, sqrt
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from crossgrad_operators.stress.case import Case, Rows
from crossgrad_operators.stress.exact import (
    Matrix,
    exact_gramian,
    finite_views,
    require_mpmath,
    weighted_sum,
)
from crossgrad_operators.stress.promises import ALL, PROMISED, Facts, Promise
from crossgrad_operators.stress.reference import Answer

#: From kappa u on only finiteness is promised: the input does not determine the result any better.
UNDETERMINED: Final = 0.1

Verdict = Literal["ok", "undetermined", "outside", "refused", "failed"]

#: Distance of a result from the nearest one that a rule for elements allows.
ElementRule = Callable[[Case, Tensor], float]


@dataclass(frozen=True)
class Finding:
    """The verdict on one result.

    Attributes:
        verdict: `ok`; `undetermined`: kappa u > 0.1 and finite; `outside`: not in the set on which
            an error is promised, finite and not too long; `refused`: K is not admitted; `failed`.
        error: Relative error in units of u kappa; NaN without a reference.
        reason: Why it failed.
    """

    verdict: Verdict
    error: float = float("nan")
    reason: str = ""

    @property
    def severity(self) -> tuple[int, float]:
        """For choosing the worst of several."""
        order = ("ok", "outside", "undetermined", "refused", "failed")
        return order.index(self.verdict), self.error


class ExactCase:
    """A case with its exact Gramian, worked out once for all operators."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.finite = finite_views(case)
        self.gramian: Matrix = exact_gramian(case)

    @property
    def touched(self) -> bool:
        """Whether any view that counts touches the block."""
        return any(f and k not in self.case.absent for k, f in enumerate(self.finite))


def judge(
    exact: ExactCase,
    found: Tensor | None,
    expected: Answer | ElementRule | None,
    promise: Promise = ALL,
) -> Finding:
    """Compares a result with exact weights, with a rule for elements, or with nothing."""
    if found is None or not exact.touched:
        return _either(found is None and not exact.touched, "None is for blocks without any view")
    if not bool(torch.isfinite(found).all()):
        return Finding("failed", inf, "not finite")
    if expected is None:
        return Finding("ok")
    if not isinstance(expected, Answer):
        longest = sqrt(float(max(exact.gramian[k][k] for k in range(exact.case.views))))
        scale = max(longest, float(found.double().norm()))
        return _measured(exact.case, expected(exact.case, found), (scale, scale))
    return _against(exact, found, expected, promise)


def _against(exact: ExactCase, found: Tensor, expected: Answer, promise: Promise) -> Finding:
    facts = facts_of(exact, expected)
    if not promise.inside(facts)[0]:
        return _outside(exact.case, found, facts, promise)
    if all(w == 0 for w in expected.weights):
        return _either(not bool(found.any()), "must be exactly zero")
    sizes = float(max(expected.largest, expected.length)), float(expected.length)
    bound = float(promise.bound(facts)[0])
    return _measured(exact.case, distance(exact.case, found, expected), sizes, bound)


def facts_of(exact: ExactCase, answer: Answer) -> Facts:
    """What sets are stated in, from 50 digits."""
    mp = require_mpmath().mp
    gramian, views = exact.gramian, range(exact.case.views)
    norms = [mp.sqrt(gramian[k][k]) for k in views]
    cosines = [
        [gramian[i][j] / norms[i] / norms[j] if norms[i] * norms[j] else mp.mpf(0) for j in views]
        for i in views
    ]
    pairs = [[(float(c), float(c - float(c))) for c in row] for row in cosines]
    return Facts(
        norms=np.array([[float(n) for n in norms]]),
        directions=np.array([pairs]),
        present=np.array([[bool(n > 0) for n in norms]]),
        weights=np.array([[float(w) for w in answer.weights]]),
        length=np.array([float(answer.length)]),
        unit=_unit(exact.case),
    )


def _unit(case: Case) -> float:
    return float(torch.finfo(case.dtype).eps) / 2


def _either(right: bool, otherwise: str) -> Finding:
    return Finding("ok", 0.0) if right else Finding("failed", inf, otherwise)


def _outside(case: Case, found: Tensor, facts: Facts, promise: Promise) -> Finding:
    ratio = float(found.double().norm()) / float(facts.longest[0])
    if ratio <= promise.factor(case.views):
        return Finding("outside")
    return Finding("failed", inf, f"{ratio:.3g} times the longest gradient")


def _measured(
    case: Case, error: float, sizes: tuple[float, float], bound: float = PROMISED
) -> Finding:
    unit, (scale, length) = _unit(case), sizes
    # What gradual underflow takes from every element cannot be relative.
    lost = sqrt(case.size) * float(torch.finfo(case.dtype).smallest_normal) * unit
    error = max(error - lost, 0.0)
    measured = error / (unit * scale) if error else 0.0
    if measured <= bound:
        return Finding("ok", measured)
    if unit * scale > UNDETERMINED * length:
        return Finding("undetermined", measured)
    return Finding("failed", measured, f"error {measured:.3g} u kappa")


def distance(case: Case, found: Tensor, expected: Answer) -> float:
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


def one_sign(case: Case, found: Tensor) -> float:
    """Distance from sums of elements of one sign: what GradDrop may choose in each place."""
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
    return float(np.linalg.norm(to_one_sign(finite, values)))


def to_one_sign(rows: Rows, values: Rows) -> Rows:
    """[..., P] distances of values from the sums of rows [..., K, P] of one sign."""
    positive, negative = rows.clip(min=0).sum(axis=-2), rows.clip(max=0).sum(axis=-2)
    return np.asarray(np.minimum(abs(values - positive), abs(values - negative)))
