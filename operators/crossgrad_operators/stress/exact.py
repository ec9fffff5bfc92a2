"""Exact Gramians and norms as 50-digit numbers (mpmath, a test dependency)."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from crossgrad_core.plugin import UserError
from crossgrad_operators.stress.case import Case, Rows

#: A 50-digit number; mpmath carries no types.
Number: TypeAlias = Any
Matrix: TypeAlias = list[list[Number]]

DIGITS = 50

#: Binary digits that products of float64 numbers span: a sum of that precision is exact.
_RANGE = 4300


def require_mpmath() -> Any:  # noqa: ANN401 - untyped
    """The module mpmath.

    Raises:
        UserError: It is not installed.
    """
    try:
        import mpmath
    except ImportError:
        raise UserError(
            "the stability suite compares with 50-digit arithmetic and needs the package mpmath",
            todo='install it: pip install "crossgrad[test]"',
        ) from None
    return mpmath


def number(value: object) -> Number:
    """A 50-digit number."""
    return require_mpmath().mp.mpf(value)


def exact_gramian(case: Case) -> Matrix:
    """[K][K] Gramian of a case, zero in rows of views that are not finite."""
    mpf = require_mpmath().mp.mpf
    views = case.views
    rows = _finite_rows(case)
    gramian = [[mpf(0)] * views for _ in range(views)]
    for i in range(views):
        for j in range(i, views):
            total = _dot(rows[0][i], rows[0][j]) + case.copies * _dot(rows[1][i], rows[1][j])
            gramian[i][j] = gramian[j][i] = total
    return gramian


def finite_views(case: Case) -> list[bool]:
    """[K] whether each view's gradient is finite."""
    both = np.concatenate([case.exact_head, case.exact_pattern], axis=1)
    return [bool(np.isfinite(row).all()) for row in both]


def weighted_sum(weights: Sequence[Number], rows: Rows) -> list[Number]:
    """[P] sum of weights times rows [K, P]; rows of weight 0 are left out."""
    mp = require_mpmath().mp
    used = [(w, row) for w, row in zip(weights, rows.tolist(), strict=True) if w != 0]
    return [mp.fdot([(w, row[i]) for w, row in used]) for i in range(rows.shape[1])]


def _finite_rows(case: Case) -> tuple[Rows, Rows]:
    finite = np.array(finite_views(case))[:, None]
    return np.where(finite, case.exact_head, 0.0), np.where(finite, case.exact_pattern, 0.0)


def _dot(a: Rows, b: Rows) -> Number:
    """The dot product of two float64 vectors, rounded once."""
    mp = require_mpmath().mp
    with mp.workprec(_RANGE):
        total = mp.fdot(zip(a.tolist(), b.tolist(), strict=True))
    return +total
