"""Linear algebra for small matrices, accurate also for diagonal elements of very different size."""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part
from crossgrad_operators.numba_kernels.digits import (
    ONE,
    Exact,
    Pair,
    Pairs,
    at,
    minus,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)
from crossgrad_operators.numba_kernels.normal import Floats, Indices

#: Smallest allowed pivot in the Cholesky factorization of a cosine matrix. Smaller pivots are
#: rounding noise of a singular matrix. With this minimum, the solution is dominated by the null
#: vector, which callers need.
PIVOT = 1e-15

#: Maximum number of Jacobi sweeps over the matrix. For 16 rows, six sweeps are enough with 16
#: digits, and eight sweeps with 32 digits.
SWEEPS = 30
#: With 32 digits, an off-diagonal element a_ij counts as zero if its magnitude is at most this
#: share of sqrt(a_ii a_jj).
NEGLIGIBLE = 1e-31
#: An element also counts as zero if its magnitude is at most this share of the largest element. The
#: share is so large that its square does not underflow in float64.
VANISHING = 1e-140


@strict_kernel
def solve(matrix: Floats, chosen: Indices, count: int, right: Floats, out: Floats) -> None:
    """Solve M_SS x = r_S by Cholesky factorization, for a subset S of rows.

    M is positive semi-definite with ones on the diagonal.

    Args:
        matrix: [K, K] matrix M.
        chosen: [K] row numbers; the first `count` entries form S.
        count: Number of rows in S.
        right: [K] right-hand side r, read at the rows in S.
        out: [K] output x, written at the rows in S.
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
    """Solve (1 + M) x = r by Cholesky factorization, for a positive semi-definite matrix M.

    The pivots of 1 + M are at least 1. If rounding makes a pivot smaller, M is so large that the
    summand 1 does not matter. Such a pivot is set to 1. x is still finite and, because the factor
    is regular, a descent direction.

    Args:
        matrix: [n, n] matrix M.
        right: [n] right-hand side r.
        out: [n] output x.
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
    """Return the last pivot of a Cholesky factorization with pivoting; the result is at least 0.

    The pivot is an upper bound of the smallest eigenvalue of the first `count` rows and columns.
    The pivot is rarely more than `count` times as large as this eigenvalue.
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


@strict_device
def _rotation(one: Pair, other: Pair, between: Pair, exact: Exact) -> tuple[Pair, Pair, Pair]:
    """Return tangent, cosine and sine of the rotation that clears an off-diagonal element."""
    theta = quotient(minus(other, one, exact), product((2.0, 0.0), between, exact), exact)
    # If theta is above this limit, theta^2 overflows, or adding 1 to theta^2 has no effect.
    far = 1e150 if exact is None else 1e17
    if abs(theta[0]) > far:
        t = quotient((0.5, 0.0), theta, exact)
    else:
        sign = 1.0 if theta[0] >= 0.0 else -1.0
        hypotenuse = root(plus(product(theta, theta, exact), ONE, exact), exact)
        size = sign * theta[0], sign * theta[1]
        t = quotient((sign, 0.0), plus(size, hypotenuse, exact), exact)
    cosine = quotient(ONE, root(plus(product(t, t, exact), ONE, exact), exact), exact)
    return t, cosine, product(t, cosine, exact)


@strict_device
def _turn(row: Pairs, p: int, q: int, cosine: Pair, sine: Pair, exact: Exact) -> None:
    """Replace the numbers a and b at p and q of a row by c a - s b and s a + c b.

    Here c is `cosine` and s is `sine`.
    """
    a, b = at(row, p), at(row, q)
    put(row, p, minus(product(cosine, a, exact), product(sine, b, exact), exact))
    put(row, q, plus(product(sine, a, exact), product(cosine, b, exact), exact))


@strict_part
def _rotate(matrix: Pairs, vectors: Pairs, p: int, q: int, exact: Exact) -> None:
    """Apply a Jacobi rotation that sets the element (p, q) of a matrix to zero.

    Update the eigenvectors.
    """
    between = at(matrix[p], q)
    one, other = at(matrix[p], p), at(matrix[q], q)
    t, cosine, sine = _rotation(one, other, between, exact)
    moved = product(t, between, exact)
    put(matrix[p], p, minus(one, moved, exact))
    put(matrix[q], q, plus(other, moved, exact))
    put(matrix[p], q, (0.0, 0.0))
    put(matrix[q], p, (0.0, 0.0))
    for k in range(len(matrix)):
        if k not in (p, q):
            _turn(matrix[k], p, q, cosine, sine, exact)
            put(matrix[p], k, at(matrix[k], p))
            put(matrix[q], k, at(matrix[k], q))
        _turn(vectors[k], p, q, cosine, sine, exact)


@strict_kernel
def eigen(matrix: Pairs, vectors: Pairs, exact: Exact) -> Floats:
    """Return the eigenvalues [n] of a positive semi-definite matrix.

    The eigenvalues are also on the diagonal of `matrix`.

    The function uses Jacobi's method. The method stops when |a_ij| <= eps sqrt(a_ii a_jj) for all
    elements a_ij. With this rule, small eigenvalues of a matrix D C D also have small relative
    errors, for any diagonal D and a well-conditioned C (Demmel and Veselic 1992).

    Args:
        matrix: [n, n] matrix, overwritten.
        vectors: [n, n] output, the eigenvectors as columns.
        exact: True for 32 digits, None for 16 digits.
    """
    n = len(matrix)
    vectors[:] = 0.0
    largest = 0.0
    for i in range(n):
        vectors[i, i, 0] = 1.0
        largest = max(largest, abs(matrix[i, i, 0]))
    share = 1.1e-16 if exact is None else NEGLIGIBLE
    least = 0.0 if exact is None else VANISHING * largest
    for _ in range(SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                one, other = max(matrix[p, p, 0], 0.0), max(matrix[q, q, 0], 0.0)
                if abs(matrix[p, q, 0]) > max(share * (np.sqrt(one) * np.sqrt(other)), least):
                    rotated = True
                    _rotate(matrix, vectors, p, q, exact)
        if not rotated:
            break
    values = np.empty(n)
    for i in range(n):
        values[i] = matrix[i, i, 0]
    return values


@strict_kernel
def lost_between(
    matrices: Floats, gramians: Floats, rounding_residuals: Floats, rounded: Floats
) -> Floats:
    """Return the rounding residuals [B, R, R] of M G M^T: the exact value minus `rounded`.

    Args:
        matrices: [B, R, K] matrices M.
        gramians: [B, K, K] Gramians G.
        rounding_residuals: [B, K, K] rounding residuals of the Gramians.
        rounded: [B, R, R] rounded values of M G M^T.
    """
    blocks, rows, views = matrices.shape
    result = np.empty(rounded.shape)
    matrix, gramian = np.zeros((rows, views, 2)), np.empty((views, views, 2))
    half = np.empty((views, 2))
    for b in range(blocks):
        matrix[:, :, 0] = matrices[b]
        gramian[:, :, 0], gramian[:, :, 1] = gramians[b], rounding_residuals[b]
        for i in range(rows):
            for k in range(views):
                put(half, k, products(gramian[k], matrix[i], 0, views, True))
            for j in range(rows):
                whole = products(half, matrix[j], 0, views, True)
                result[b, i, j] = minus(whole, (rounded[b, i, j], 0.0), True)[0]
    return result
