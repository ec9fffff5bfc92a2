"""Compare operators with 50-digit arithmetic on a case that the user specifies."""

import json
from collections.abc import Sequence

import numpy as np
import torch

from crossgrad_core.plugin import UserError
from crossgrad_operators.stress.cases import Case, short
from crossgrad_operators.stress.exact import DIGITS, require_mpmath
from crossgrad_operators.stress.runner import Cell, judged
from crossgrad_operators.stress.search.families import search_views
from crossgrad_operators.stress.suite import Subject
from crossgrad_operators.stress.verdict import ExactCase, Finding


def read_rows(text: str, dtype: torch.dtype) -> Case:
    """Return the case that a text describes, such as [[1,2],[3,4]]. Each row belongs to one view.

    Raises:
        UserError: The text is not a matrix of finite numbers.
    """
    try:
        rows = np.array(json.loads(text), np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise _no_matrix(text) from error
    if rows.ndim != 2 or not rows.size:  # noqa: PLR2004
        raise _no_matrix(text)
    with np.errstate(over="ignore"):
        case = short(str(dtype).removeprefix("torch."), rows, dtype)
        finite = np.isfinite(case.exact_head).all()
    # The values are tested after rounding to the type, because rounding may overflow.
    if not finite:
        raise _no_matrix(text)
    return case


def run_rows(subjects: Sequence[Subject], case: Case) -> list[Cell]:
    """Run all operators on one case, as in the search."""
    mpmath = require_mpmath()
    with mpmath.mp.workdps(DIGITS):
        exact = ExactCase(case)
        return [_cell(subject, exact) for subject in subjects]


def _cell(subject: Subject, exact: ExactCase) -> Cell:
    if not subject.operator.views.admits(exact.case.views):
        return Cell(subject.name, exact.case.name, Finding("refused"))
    finding, times = judged(subject.operator, exact, subject.reference, search_views)
    return Cell(subject.name, exact.case.name, finding, 1e6 * min(times, default=float("nan")))


def _no_matrix(text: str) -> UserError:
    return UserError(
        "the gradients are not a matrix of finite numbers",
        where="--rows",
        expected="one row of equal length for each view, such as [[1,2],[3,4]]",
        found=text if len(text) <= 80 else f"{text[:80]} ...",  # noqa: PLR2004
        todo="copy the text that the search printed after --rows, including the quotes",
    )
