"""Linear algebra of matrices of a few rows, accurate for graded ones."""

import numpy as np

from crossgrad_core.numerics.jit import strict_kernel
from crossgrad_operators.numba_kernels.normal import Floats, Indices

#: Smallest pivot of a Cholesky factor of cosines. Smaller ones are rounding noise of a singular
#: matrix; the solution is then dominated by the null vector, which is what callers look for.
PIVOT = 1e-15

#: Sweeps of Jacobi's method; six are enough for sixteen rows.
SWEEPS = 30


@strict_kernel
def solve(matrix: Floats, chosen: Indices, count: int, right: Floats, out: Floats) -> None:
    """Solves M_SS x = r_S for positive semi-definite M of unit diagonal by Cholesky.

    Args:
        matrix: [K, K].
        chosen: [K] the first `count` entries are the members of S.
        count: Size of S.
        right: [K] right-hand side, read at the members of S.
        out: [K] solution, written at the members of S.
    """
    lower = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            total = matrix[chosen[i], chosen[j]]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = np.sqrt(max(total, PIVOT))
            else:
                lower[i, j] = total / lower[j, j]
    x = np.empty(count)
    for i in range(count):
        total = right[chosen[i]]
        for k in range(i):
            total -= lower[i, k] * x[k]
        x[i] = total / lower[i, i]
    for i in range(count - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, count):
            total -= lower[k, i] * x[k]
        x[i] = total / lower[i, i]
    for i in range(count):
        out[chosen[i]] = x[i]


@strict_kernel
def solve_shifted(matrix: Floats, right: Floats, out: Floats) -> None:
    """Solves (1 + M) x = r for positive semi-definite M by Cholesky.

    The pivots of 1 + M are at least 1; where rounding says otherwise, M is too large for the 1 to
    count, and x is still finite and, as the factor is regular, not uphill.

    Args:
        matrix: [n, n] M.
        right: [n] right-hand side.
        out: [n] solution.
    """
    n = right.size
    lower = np.zeros((n, n))
    for i in range(n):
        total = right[i]
        for j in range(i):
            entry = matrix[i, j]
            for k in range(j):
                entry -= lower[i, k] * lower[j, k]
            lower[i, j] = entry / lower[j, j]
            total -= lower[i, j] * out[j]
        pivot = 1.0 + matrix[i, i]
        for k in range(i):
            pivot -= lower[i, k] * lower[i, k]
        lower[i, i] = np.sqrt(max(pivot, 1.0))
        out[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * out[k]
        out[i] = total / lower[i, i]


@strict_kernel
def smallest_pivot(cosines: Floats, count: int) -> float:
    """The last pivot of Cholesky's factor with the largest pivot first; at least 0.

    It is above the smallest eigenvalue of the first `count` rows, and seldom more than `count`
    times.
    """
    rest = cosines[:count, :count].copy()
    pivot = 1.0
    for step in range(count):
        best = step
        for i in range(step + 1, count):
            if rest[i, i] > rest[best, best]:
                best = i
        for i in range(count):
            rest[step, i], rest[best, i] = rest[best, i], rest[step, i]
        for i in range(count):
            rest[i, step], rest[i, best] = rest[i, best], rest[i, step]
        pivot = max(rest[step, step], 0.0)
        if pivot == 0.0:
            return 0.0
        for i in range(step + 1, count):
            for j in range(step + 1, count):
                rest[i, j] -= rest[i, step] * rest[step, j] / pivot
    return pivot


@strict_kernel
def eigen(matrix: Floats, vectors: Floats) -> Floats:
    """Eigenvalues [n] of a positive semi-definite matrix (destroyed), vectors [n, n] as columns.

    Jacobi's method with the stopping rule |a_ij| <= eps sqrt(a_ii a_jj): small eigenvalues of
    matrices D C D with a well-conditioned C keep their relative accuracy, whatever the diagonal D
    (Demmel and Veselic 1992).
    """
    n = matrix.shape[0]
    vectors[:] = 0.0
    for i in range(n):
        vectors[i, i] = 1.0
    for _ in range(SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                apq = matrix[p, q]
                scale = np.sqrt(max(matrix[p, p], 0.0)) * np.sqrt(max(matrix[q, q], 0.0))
                if apq == 0.0 or abs(apq) <= 1.1e-16 * scale:
                    continue
                rotated = True
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * apq)
                if abs(theta) > 1e150:
                    t = 0.5 / theta
                else:
                    t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                    t = t if theta >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                matrix[p, p] -= t * apq
                matrix[q, q] += t * apq
                matrix[p, q] = 0.0
                matrix[q, p] = 0.0
                for k in range(n):
                    if k not in (p, q):
                        akp, akq = matrix[k, p], matrix[k, q]
                        matrix[k, p] = c * akp - s * akq
                        matrix[p, k] = matrix[k, p]
                        matrix[k, q] = s * akp + c * akq
                        matrix[q, k] = matrix[k, q]
                    vkp, vkq = vectors[k, p], vectors[k, q]
                    vectors[k, p] = c * vkp - s * vkq
                    vectors[k, q] = s * vkp + c * vkq
        if not rotated:
            break
    values = np.empty(n)
    for i in range(n):
        values[i] = matrix[i, i]
    return values
