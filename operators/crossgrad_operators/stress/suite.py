"""The complete test suite: all operators on all cases and all laws, with the results as text."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.commands import build, write_table
from crossgrad_core.commands import names as installed_names
from crossgrad_core.plugin import EMPTY_STATE, Block, LearningRate, MatrixOperator, Operator
from crossgrad_operators.stress.cases import Case, short
from crossgrad_operators.stress.exact import DIGITS, require_mpmath
from crossgrad_operators.stress.promises import PROMISED, Promise, promise_of
from crossgrad_operators.stress.reference import OPTIONS, ORACLES, Views, chained, sample_views
from crossgrad_operators.stress.runner import BLOCK, Cell, Reference, context_of, run_case, timed
from crossgrad_operators.stress.verdict import ExactCase, Finding, one_sign

#: Function that returns the error of a law in units of u times the largest norm. If the law does
#: not apply, the function returns None.
Law = Callable[[Operator], float | None]
_UNIT = 2.0**-24
#: Number of operators in one part of the table.
COLUMNS = 5
_NAME, _CELL = 24, 16
LEGEND = (
    "Each cell: relative error in units of u kappa (at most 8 is guaranteed), and microseconds.\n"
    "u: unit roundoff of the gradients' type. kappa: max |w_k| |g_k| / |result|, at least 1.\n"
    "~ kappa u > 0.1: the result is only guaranteed to be finite.\n"
    "* outside the operator's set (docs/operators.md): the result is finite and not too long.\n"
    "- the operator refuses this number of gradients. FAIL: the failures are listed at the end.\n"
    "A cell without an error has no reference: the result is finite and the laws hold."
)


def _rows(views: int) -> Case:
    rows = np.random.default_rng(70 + views).standard_normal((views, 48))
    return short("law", rows - 0.6 * rows.mean(axis=0))


def _result(operator: Operator, case: Case, views: Views | None = None) -> Tensor:
    gradient, _, _ = timed(operator, case, views or sample_views(case.views))
    if gradient is None:
        raise RuntimeError("a view has no gradient, but all views must have one")
    return gradient.double()


def _error(result: Tensor, expected: Tensor, case: Case) -> float:
    longest = float(np.linalg.norm(case.exact_head, axis=1).max())
    scale = max(longest, float(expected.norm()))
    return float((result - expected).norm()) / (_UNIT * scale)


def _counts(operator: Operator) -> Iterator[int]:
    yield from (k for k in (2, 3, 4, 8) if operator.views.admits(k))


def homogeneity(operator: Operator) -> float | None:
    """Return the error of the law op(c g) = c op(g), for factors c of 2^-80, 3 and 2^80."""
    worst = 0.0
    for views in _counts(operator):
        case = _rows(views)
        for c in (2.0**-80, 3.0, 2.0**80):
            scaled = replace(case, head=case.exact_head * c)
            rounded = replace(case, head=scaled.exact_head / c)
            result = _result(operator, scaled) / c
            worst = max(worst, _error(result, _result(operator, rounded), case))
    return worst


def permutation(operator: Operator) -> float | None:
    """Return the error after two views were exchanged together with their labels and distances."""
    if not operator.views.admits(2):
        return None
    case, views = _rows(2), sample_views(2)
    turned = replace(case, head=case.head[::-1].copy())
    turned_views = Views(views.labels[::-1], views.ratios[::-1], views.seed)
    result = _result(operator, turned, turned_views)
    return _error(result, _result(operator, case, views), case)


def one_view(operator: Operator) -> float | None:
    """Return how much an operator changes a single view at the reference distance.

    An operator should not change a single view, so that the expected value is 0.
    """
    if not operator.views.admits(1):
        return None
    case = _rows(1)
    result = _result(operator, case, Views(("near",), (1.0,), 0))
    return _error(result, torch.from_numpy(case.exact_head[0]), case)


def size(operator: Operator) -> float | None:
    """Return the error for gradients that are repeated 3,001 times.

    The reference is the result for the original gradients, repeated as often.
    """
    if not isinstance(operator, MatrixOperator):
        return None
    worst = 0.0
    for views in _counts(operator):
        case = _rows(views)
        copies = 3001
        tiled = replace(case, head=np.zeros((views, 0)), pattern=case.head, copies=copies)
        expected = _result(operator, case)
        result = _result(operator, tiled).view(copies, -1)
        worst = max(worst, *(_error(row, expected, case) for row in (result[0], result[-1])))
    return worst


def block_independence(operator: Operator) -> float | None:
    """Return 0 if other blocks in a step do not change the bits of a block's result, else inf."""
    if not isinstance(operator, MatrixOperator):
        return None
    for views in _counts(operator):
        case, circumstances = _rows(views), sample_views(views)
        other = Block("scales", ("scales",), False, "geometry", LearningRate(1.0))
        gradients = [{"means": g, "scales": _reversed(g)} for g in case.gradients()]
        context = context_of(gradients, (other, BLOCK), circumstances)
        result = operator.aggregate(context, EMPTY_STATE)[0].gradients["means"]
        if result is None or not torch.equal(result.double(), _result(operator, case)):
            return float("inf")
    return 0.0


def threads(operator: Operator) -> float | None:
    """Return 0 if the number of threads does not change the bits of the result, else inf."""
    import numba

    case = replace(_rows(2), pattern=_rows(2).head, copies=8000)
    if not operator.views.admits(2):
        return None
    before = numba.get_num_threads()
    results = []
    try:
        for count in {1, before}:
            numba.set_num_threads(count)
            results.append(_result(operator, case))
    finally:
        numba.set_num_threads(before)
    return 0.0 if all(torch.equal(results[0], r) for r in results) else float("inf")


LAWS: tuple[Law, ...] = (homogeneity, permutation, one_view, size, block_independence, threads)


def run_law(name: str, operator: Operator, law: Law) -> Cell:
    """Return the result of one law for one operator."""
    return Cell(name, law.__name__.replace("_", " "), _judged(operator, law))


def _judged(operator: Operator, law: Law) -> Finding:
    try:
        error = law(operator)
    except Exception as problem:
        # An operator of another package may raise any exception.
        return Finding("failed", reason=f"{type(problem).__name__}: {problem}")
    if error is None:
        return Finding("refused")
    if error <= PROMISED:
        return Finding("ok", error)
    return Finding("failed", error, f"error {error:.3g} u")


def _reversed(gradient: Tensor | None) -> Tensor | None:
    return None if gradient is None else gradient.flip(0)


def installed() -> list[str]:
    """Return the names of all installed operators, including operators of other packages."""
    return installed_names("operators")


def made(name: str) -> Operator:
    """Return an operator with the options that the test suite uses."""
    return build(Operator, name, OPTIONS.get(name, {}))


@dataclass(frozen=True, eq=False)
class Subject:
    """An operator together with its reference.

    Attributes:
        name: Name of the operator.
        operator: The operator.
        reference: The operator's oracle with 50 digits, or its rule for elements; empty for
            operators of other packages.
    """

    name: str
    operator: Operator
    reference: Reference

    @property
    def promise(self) -> Promise:
        """The guarantee of the operator."""
        return self.reference.promise


def subject_of(name: str) -> Subject:
    """Return the installed operator with a name.

    If the operator is built-in, its reference is included.

    Raises:
        UserError: The operator does not exist or cannot be created.
    """
    operator = made(name)
    return Subject(name, operator, reference_of(name, operator))


def run_suite(
    names: Sequence[str], cases: Sequence[Case], progress: Callable[[str], None] = lambda _: None
) -> Iterator[Cell]:
    """Yield the results of all operators: first for each case, then for each law.

    Raises:
        UserError: mpmath is not installed, or an operator cannot be created.
    """
    mpmath = require_mpmath()
    subjects = [subject_of(name) for name in names]
    with mpmath.mp.workdps(DIGITS):
        for case in cases:
            progress(case.name)
            exact = ExactCase(case)
            for subject in subjects:
                yield run_case(subject.name, subject.operator, exact, subject.reference)
        for law in LAWS:
            progress(law.__name__)
            yield from (run_law(subject.name, subject.operator, law) for subject in subjects)


def reference_of(name: str, operator: Operator) -> Reference:
    """Return the reference of a built-in operator.

    Operators of other packages have no reference.
    """
    options: dict[str, Any] = {
        field: getattr(operator, field) for field in type(operator).model_fields
    }
    if not type(operator).__module__.startswith("crossgrad_operators."):
        return Reference(None, options)
    if name == "graddrop":
        return Reference(None, options, one_sign, promise_of(name))
    oracle = chained if name == "chain" else ORACLES.get(name)
    return Reference(oracle, options, promise=promise_of(name))


def as_text(cells: Sequence[Cell]) -> str:
    """Return the complete table, the worst error of each operator, and all failures."""
    names = list(dict.fromkeys(cell.operator for cell in cells))
    parts = [
        _part(cells, names[start : start + COLUMNS]) for start in range(0, len(names), COLUMNS)
    ]
    return "\n\n".join([*parts, LEGEND, _summary(cells, names), *_failures(cells)])


def failed(cells: Sequence[Cell]) -> list[Cell]:
    """Return the results that break a guarantee."""
    return [cell for cell in cells if cell.finding.verdict == "failed"]


def write_csv(cells: Sequence[Cell], path: Path) -> None:
    """Write one row for each result."""
    rows: list[dict[str, str | int | float]] = [
        {
            "operator": cell.operator,
            "case": cell.case,
            "verdict": cell.finding.verdict,
            "error_u_kappa": cell.finding.error,
            "microseconds": cell.microseconds,
            "reason": cell.finding.reason,
        }
        for cell in cells
    ]
    write_table(path, rows)


def _part(cells: Sequence[Cell], names: Sequence[str]) -> str:
    by_place = {(cell.case, cell.operator): cell for cell in cells}
    lines = [" " * _NAME + "".join(f"{name:>{_CELL}}" for name in names)]
    for case in dict.fromkeys(cell.case for cell in cells):
        row = "".join(f"{_shown(by_place[case, name]):>{_CELL}}" for name in names)
        lines.append(f"{case:<{_NAME}}{row}")
    return "\n".join(lines)


def _shown(cell: Cell) -> str:
    time = "" if isnan(cell.microseconds) else f"{cell.microseconds:8.0f}"
    if cell.finding.verdict == "refused":
        return "-" + " " * 8
    if cell.finding.verdict == "failed":
        return "FAIL" + (time or " " * 8)
    mark = {"undetermined": "~", "outside": "*"}.get(cell.finding.verdict, "")
    error = f"{cell.finding.error:.2f}" if isfinite(cell.finding.error) else ""
    return f"{mark}{error}{time or ' ' * 8}"


def _summary(cells: Sequence[Cell], names: Sequence[str]) -> str:
    lines = [f"{'operator':<{_NAME}}{'worst error':>12}  of {PROMISED:g}   in case"]
    for name in names:
        judged = [c for c in cells if c.operator == name and c.finding.verdict == "ok"]
        worst = max(
            (c for c in judged if isfinite(c.finding.error)),
            key=lambda c: c.finding.error,
            default=None,
        )
        if worst is not None:
            lines.append(f"{name:<{_NAME}}{worst.finding.error:>12.3f}         {worst.case}")
    return "\n".join(lines)


def _failures(cells: Sequence[Cell]) -> list[str]:
    wrong = failed(cells)
    total = sum(cell.finding.verdict != "refused" for cell in cells)
    if not wrong:
        return [f"all {total} checks hold"]
    lines = [f"{cell.operator}, {cell.case}: {cell.finding.reason}" for cell in wrong]
    return ["\n".join([f"{len(wrong)} of {total} checks fail:", *lines])]
