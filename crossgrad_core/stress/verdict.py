"""Whether a result is as close to the exact one as promised."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf, sqrt
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.stress.case import Case
from crossgrad_core.stress.exact import Matrix, exact_gramian, finite_views, weighted_sum
from crossgrad_core.stress.reference import Answer

#: Relative error that is promised, in units of u kappa.
PROMISED: Final = 8.0
#: From kappa u on only finiteness is promised: the input does not determine the result any better.
UNDETERMINED: Final = 0.1

Verdict = Literal["ok", "undetermined", "refused", "failed"]

#: Distance of a result from the nearest one that a rule for elements allows.
ElementRule = Callable[[Case, Tensor], float]


@dataclass(frozen=True)
class Finding:
    """What is to be said about one result.

    Attributes:
        verdict: `ok`; `undetermined`: kappa u > 0.1 and finite; `refused`: K is not admitted;
            `failed`.
        error: Relative error in units of u kappa (8 is promised); NaN without a reference.
        reason: Why it failed.
    """

    verdict: Verdict
    error: float = float("nan")
    reason: str = ""

    @property
    def severity(self) -> tuple[int, float]:
        """For choosing the worst of several."""
        order = ("ok", "undetermined", "refused", "failed")
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


def judge(exact: ExactCase, found: Tensor | None, expected: Answer | ElementRule | None) -> Finding:
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
        return _measured(exact.case, expected(exact.case, found), scale, scale)
    if all(w == 0 for w in expected.weights):
        return _either(not bool(found.any()), "must be exactly zero")
    scale, length = float(max(expected.largest, expected.length)), float(expected.length)
    return _measured(exact.case, distance(exact.case, found, expected), scale, length)


def _either(right: bool, otherwise: str) -> Finding:
    return Finding("ok", 0.0) if right else Finding("failed", inf, otherwise)


def _measured(case: Case, error: float, scale: float, length: float) -> Finding:
    unit = float(torch.finfo(case.dtype).eps) / 2
    # What gradual underflow takes from every element cannot be relative.
    lost = sqrt(case.size) * float(torch.finfo(case.dtype).smallest_normal) * unit
    error = max(error - lost, 0.0)
    measured = error / (unit * scale) if error else 0.0
    if measured <= PROMISED:
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


def _to_nearest_sign(rows: np.ndarray, values: np.ndarray) -> float:
    finite = rows[np.isfinite(rows).all(axis=1)]
    positive, negative = finite.clip(min=0).sum(axis=0), finite.clip(max=0).sum(axis=0)
    nearest = np.minimum(abs(values - positive), abs(values - negative))
    return float(np.linalg.norm(nearest))
