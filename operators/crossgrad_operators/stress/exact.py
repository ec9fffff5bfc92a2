"""Exact Gramians and norms with 50 digits, and linear algebra for small matrices.

The numbers come from mpmath, a package that only tests require.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from crossgrad_core.plugin import UserError
from crossgrad_operators.stress.cases import Case, Rows

#: A 50-digit number. mpmath has no type annotations.
Number: TypeAlias = Any
Matrix: TypeAlias = list[list[Number]]
DIGITS = 50
#: Range of the binary exponents of products of float64 numbers. Sums with this number of bits are
#: exact.
_RANGE = 4300
Vector = list[Number]
#: Pivots below this relative size count as zero. Exactly singular matrices have pivots of about
#: 1e-50.
SINGULAR = "1e-35"
#: Length of a step along a null vector. The step is so long that some element reaches zero before
#: its end.
FAR = 10**30


def require_mpmath() -> Any:  # noqa: ANN401 - untyped
    """Return the module mpmath.

    Raises:
        UserError: mpmath is not installed.
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
    """Return a 50-digit number."""
    return require_mpmath().mp.mpf(value)


def exact_gramian(case: Case) -> Matrix:
    """Return the Gramian [K][K] of a case. Rows of views with non-finite gradients are zero."""
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
    """Return whether the gradient of each view [K] is finite."""
    both = np.concatenate([case.exact_head, case.exact_pattern], axis=1)
    return [bool(np.isfinite(row).all()) for row in both]


def weighted_sum(weights: Sequence[Number], rows: Rows) -> list[Number]:
    """Return the sum [P] of weights times rows [K, P]. Rows with weight 0 are left out."""
    mp = require_mpmath().mp
    used = [(w, row) for w, row in zip(weights, rows.tolist(), strict=True) if w != 0]
    return [mp.fdot([(w, row[i]) for w, row in used]) for i in range(rows.shape[1])]


def _finite_rows(case: Case) -> tuple[Rows, Rows]:
    finite = np.array(finite_views(case))[:, None]
    return np.where(finite, case.exact_head, 0.0), np.where(finite, case.exact_pattern, 0.0)


def _dot(a: Rows, b: Rows) -> Number:
    """Return the dot product of two float64 vectors, computed exactly and rounded once."""
    mp = require_mpmath().mp
    with mp.workprec(_RANGE):
        total = mp.fdot(zip(a.tolist(), b.tolist(), strict=True))
    return +total


def dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """Return the dot product a.b."""
    return require_mpmath().mp.fdot(zip(a, b, strict=True))


def apply(matrix: Matrix, x: Sequence[Number]) -> Vector:
    """Return the product of the matrix and the vector x."""
    return [dot(row, x) for row in matrix]


def form(matrix: Matrix, x: Sequence[Number]) -> Number:
    """Return the quadratic form x^T M x of the matrix M."""
    return dot(x, apply(matrix, x))


def solve(matrix: Matrix, support: Sequence[int], right: Sequence[Number]) -> Vector | None:
    """Return x with (M x)_S = right_S and with zeros outside the rows S.

    Return None if M_SS is singular.

    M is positive semi-definite, and S is `support`. The function uses the Cholesky factorization L
    D L^T = M_SS.
    """
    mp = require_mpmath().mp
    # Scale M by its diagonal, so that a large ratio of norms does not make M look singular.
    unit = [mp.sqrt(matrix[i][i]) for i in support]
    lower: list[Vector] = []
    diagonal: Vector = []
    y: Vector = []
    for i, row in enumerate(support):
        scaled: Vector = []
        for j in range(i):
            entry = matrix[row][support[j]] / unit[i] / unit[j]
            scaled.append(entry - dot(scaled, lower[j]))
        lower.append([value / pivot for value, pivot in zip(scaled, diagonal, strict=True)])
        pivot = 1 - dot(scaled, lower[i])
        if pivot <= mp.mpf(SINGULAR):
            return None
        diagonal.append(pivot)
        y.append(right[row] / unit[i] - dot(lower[i], y))
    x = [mp.mpf(0)] * len(matrix)
    solved: Vector = []
    for i in reversed(range(len(support))):
        later = [lower[k][i] for k in range(len(support) - 1, i, -1)]
        solved.append(y[i] / diagonal[i] - dot(later, solved))
        x[support[i]] = solved[-1] / unit[i]
    return x


def complementary(matrix: Matrix, offset: Sequence[Number]) -> Vector | None:
    """Return x >= 0 with s = M x + `offset` >= 0 and x.s = 0.

    The conditions are the optimality conditions of a quadratic program.

    The function uses the active-set method of Lawson and Hanson, and checks the result. In each
    step, the most violated constraint becomes active. If the column of this constraint is a
    combination of active columns, an active constraint is removed first. M may be singular, because
    dependent columns are never active together. If no solution exists, the function returns None.
    """
    mp = require_mpmath().mp
    x = [mp.mpf(0)] * len(matrix)
    active: set[int] = set()
    for _ in range(10 * len(matrix)):
        slack = [m + o for m, o in zip(apply(matrix, x), offset, strict=True)]
        tolerance = mp.mpf(SINGULAR) * max(1, *x)
        waiting = [i for i in range(len(matrix)) if i not in active]
        worst = min(waiting, key=lambda i: slack[i], default=None)
        if worst is None or slack[worst] >= -tolerance:
            met = all(abs(slack[i]) <= tolerance for i in active)
            return x if met else None
        active.add(worst)
        if not _settle(matrix, offset, x, active, worst):
            return None
    return None


def _settle(
    matrix: Matrix, offset: Sequence[Number], x: list[Number], active: set[int], entered: int
) -> bool:
    """Solve for the active elements of x.

    Remove elements that reach zero on the way from the active set.
    """
    least = require_mpmath().mp.mpf("1e-300")
    while active:
        target = solve(matrix, sorted(active), [-o for o in offset])
        if target is None:
            # x can move along a null vector, because the new column is a combination of the other
            # active columns.
            rest = sorted(active - {entered})
            along = solve(matrix, rest, [-row[entered] for row in matrix])
            if along is None or all(v >= 0 for v in along):
                return False
            target = [x[i] + FAR * along[i] for i in range(len(x))]
            target[entered] = x[entered] + FAR
            target = [v if i in active else x[i] for i, v in enumerate(target)]
        falling = {i: x[i] / max(x[i] - target[i], least) for i in active if target[i] <= 0}
        share = min(falling.values(), default=1)
        for i in active:
            x[i] += share * (target[i] - x[i])
        for i in [i for i, step_share in falling.items() if step_share == share]:
            x[i] *= 0
            active.remove(i)
        if not falling:
            return True
    return True


def pivots(matrix: Matrix) -> Vector:
    """Return the Cholesky pivots of a positive semi-definite matrix, in descending order."""
    left = [list(row) for row in matrix]
    positive_pivots = []
    while left:
        k = max(range(len(left)), key=lambda i: left[i][i])
        pivot, column = left[k][k], left[k]
        if pivot <= 0:
            break
        positive_pivots.append(pivot)
        kept = [i for i in range(len(left)) if i != k]
        left = [[left[i][j] - column[i] * column[j] / pivot for j in kept] for i in kept]
    return positive_pivots
