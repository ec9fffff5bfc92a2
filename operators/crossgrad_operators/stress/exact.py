"""Exact Gramians and norms as 50-digit numbers (mpmath, a test dependency)."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np

from crossgrad_core.plugin import UserError
from crossgrad_operators.stress.case import Case, Rows

#: A 50-digit number; mpmath carries no types.
Number: TypeAlias = Any
Matrix: TypeAlias = list[list[Number]]

DIGITS = 50

#: Halves of a float64 that multiply without error (Dekker 1971).
_SPLITTER = 2.0**27 + 1.0


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
    """The dot product of two float64 vectors without any error worth mentioning.

    Every product is split into float64 numbers that add up to it exactly, and these are added with
    `math.fsum`, which rounds once; doing it again on what is left gives the next digits.
    """
    mpf = require_mpmath().mp.mpf
    # Powers of two keep splitting and products inside the range of float64.
    first, second = _scaled(a), _scaled(b)
    terms = [term for term in _products(first[0], second[0]) if term]
    total = mpf(0)
    for _ in range(4):
        part = _fsum(terms)
        if not part:
            break
        total += mpf(part)
        terms.append(-part)
    return total * mpf(2) ** (first[1] + second[1])


def _fsum(terms: Iterable[float]) -> float:
    return math.fsum(terms)


def _scaled(vector: Rows) -> tuple[Rows, int]:
    largest = float(np.abs(vector).max(initial=0.0))
    if largest == 0.0:
        return vector, 0
    exponent = int(math.frexp(largest)[1])
    return np.ldexp(vector, -exponent), exponent


def _products(a: Rows, b: Rows) -> list[float]:
    """Float64 numbers that add up to sum a_i b_i exactly, short of underflow at 1e-308."""
    product = a * b
    a_high, b_high = _high(a), _high(b)
    a_low, b_low = a - a_high, b - b_high
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return [*product.tolist(), *error.tolist()]


def _high(x: Rows) -> Rows:
    scaled = _SPLITTER * x
    high: Rows = scaled - (scaled - x)
    return high
