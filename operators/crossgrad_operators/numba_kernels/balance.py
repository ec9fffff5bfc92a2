"""Kernels for equal projections (IMTL-G), bargaining (Nash-MTL), equal singular values (Aligned).

Each kernel can compute with 16 or with 32 digits. Each kernel marks the blocks for which rounding
of the Gramian may affect a result with 16 digits.
"""

import math

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part
from crossgrad_operators.numba_kernels.digits import (
    ONE,
    Exact,
    Pair,
    Pairs,
    at,
    longest_of,
    minus,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)
from crossgrad_operators.numba_kernels.directions import Solved, cancels, directions
from crossgrad_operators.numba_kernels.linear import (
    eigen,
    smallest_pivot,
    solve,
    solve_shifted,
)
from crossgrad_operators.numba_kernels.normal import (
    CANCELLED,
    CAUTION,
    EPSILON,
    OPPOSITE,
    Flags,
    Floats,
    Indices,
)

#: Maximum number of Newton steps of Nash-MTL. About ten steps are usually enough.
STEPS = 200
#: The iteration ends when the Newton decrement is below this value.
DECREMENT = 1e-13
#: Below this Newton decrement, full Newton steps converge quadratically.
CLOSE = 0.25
#: If beta exceeds this value, the bargaining problem has no finite solution. If beta exceeds 7e5
#: sqrt(K), the limit `CANCELLED` already sets the result to zero.
ENDLESS = 3e7
#: Maximum number of additional Newton steps with 32 digits. For a condition number kappa of at most
#: 1e5, two steps are enough.
POLISHING = 20


@strict_part
def _of_present(
    gramian: Floats, remainder: Floats, present: Flags, exact: Exact
) -> tuple[Indices, Pairs, Pairs]:
    """Return the indices [n] of present views, their norms [n] and their cosines [n, n]."""
    views = present.size
    norms, cosines = np.zeros((views, 2)), np.zeros((views, views, 2))
    count = directions(gramian, remainder, present, norms, cosines, exact)
    places = np.flatnonzero(present)
    if count < views:
        return places, norms[places], cosines[places][:, places, :]
    return places, norms, cosines


@strict_device
def _graded(norms: Pairs, cosines: Pairs, exact: Exact) -> Pairs:
    """Return D C D [n, n] for the cosines C.

    The diagonal matrix D contains the norms, divided by the largest norm.

    D C D and C have equal ranks. If the ratio of norms is large, the eigenvalues of D C D do not
    show this rank.
    """
    n = len(norms)
    longest, _ = longest_of(norms)
    shares, gramian = np.empty((n, 2)), np.empty((n, n, 2))
    for i in range(n):
        put(shares, i, quotient(at(norms, i), longest, exact))
    for i in range(n):
        for j in range(n):
            half = product(at(shares, i), at(cosines[i], j), exact)
            put(gramian[i], j, product(half, at(shares, j), exact))
    return gramian


@strict_device
def _add(out: Pairs, factor: Pair, vector: Pairs, exact: Exact) -> None:
    """Add `factor` times `vector` to `out`."""
    for k in range(len(out)):
        put(out, k, plus(at(out, k), product(factor, at(vector, k), exact), exact))


@strict_device
def _add_solution(
    matrix: Pairs,
    vectors: Pairs,
    chosen: Indices,
    right: Pairs,
    least: float,
    v: Pairs,
    exact: Exact,
) -> None:
    """Add x_i (x_i.r) / l_i to `v` for the chosen eigenvectors x_i.

    The l_i are the eigenvalues, and r is the right-hand side.

    An eigenvector x_i is skipped if |x_i.r| is at most `least` times the sum of the magnitudes of
    its terms. A skipped eigenvector is orthogonal to r, except for rounding noise.
    """
    for i in chosen:
        inner = products(vectors[:, i], right, 0, len(v), exact)
        size = 0.0
        for k in range(len(v)):
            size += abs(vectors[k, i, 0]) * right[k, 0]
        if abs(inner[0]) > least * size:
            _add(v, quotient(inner, at(matrix[i], i), exact), vectors[:, i], exact)


@strict_part
def _equal_projections(norms: Pairs, cosines: Pairs, v: Pairs, exact: Exact) -> float:
    """Solve G v = (|g_k|) for v.

    If G is singular, v is the least-squares solution with the smallest norm.

    Returns:
        The smallest eigenvalue of the cosine matrix, divided by the largest.
    """
    n = len(norms)
    matrix, vectors = cosines.copy(), np.empty((n, n, 2))
    values = eigen(matrix, vectors, exact)
    smallest: float = values.min() / values.max()
    rank = 0
    for i in range(n):
        rank += values[i] > OPPOSITE * values.max()
    if rank < n:
        matrix = _graded(norms, cosines, exact)
        order = np.argsort(eigen(matrix, vectors, exact))
        _add_solution(matrix, vectors, order[n - rank :], norms, OPPOSITE, v, exact)
        return smallest
    if exact is None:
        solve(cosines[:, :, 0].copy(), np.arange(n), n, np.ones(n), v[:, 0])
    else:
        ones = np.zeros((n, 2))
        ones[:, 0] = 1.0
        _add_solution(matrix, vectors, np.arange(n), ones, 0.0, v, exact)
    for i in range(n):
        put(v, i, quotient(at(v, i), at(norms, i), exact))
    return smallest


@strict_kernel
def imtl_g(
    gramians: Floats, rounding_residuals: Floats, present: Flags, unit: float, exact: Exact
) -> Solved:
    """Return weights with sum 1 whose combination has equal projections on all unit gradients.

    Args:
        gramians: [B, K, K] Gramians.
        rounding_residuals: [B, K, K] rounding residuals of the Gramians; unused with 16 digits.
        present: [B, K] True for views that have a gradient.
        unit: Largest relative error for which a result with 16 digits is accepted.
        exact: True for 32 digits, None for 16 digits.

    Returns:
        [B, K] weights, and [B] True for ill-conditioned weights.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    for b in range(blocks):
        places, norms, cosines = _of_present(gramians[b], rounding_residuals[b], present[b], exact)
        n = places.size
        if n == 1:
            result[b, places[0]] = 1.0
        elif n == 2:
            if 1.0 + cosines[0, 1, 0] > OPPOSITE:
                for i in range(n):
                    result[b, places[i]] = norms[1 - i, 0] / (norms[0, 0] + norms[1, 0])
        elif n > 2:
            ill_conditioned[b] = _same_shares(norms, cosines, places, unit, result[b], exact)
    return result, ill_conditioned


@strict_part
def _same_shares(
    norms: Pairs, cosines: Pairs, places: Indices, unit: float, weights: Floats, exact: Exact
) -> bool:
    """Write the weights of more than two views to `weights`.

    Return True if the weights are ill-conditioned.
    """
    n = places.size
    longest, _ = longest_of(norms)
    scaled, v, x = np.empty((n, 2)), np.zeros((n, 2)), np.empty((n, 2))
    for i in range(n):
        put(scaled, i, quotient(at(norms, i), longest, exact))
    smallest = _equal_projections(scaled, cosines, v, exact)
    total, sizes, largest = (0.0, 0.0), 0.0, 0.0
    for i in range(n):
        total = plus(total, at(v, i), exact)
        sizes += abs(v[i, 0])
        largest = max(largest, abs(v[i, 0]))
        put(x, i, product(at(v, i), at(scaled, i), exact))
    # The sum of v, or the weighted sum of the gradients, may be only rounding noise. If one of
    # these sums is only rounding noise, all weights stay zero.
    if total[0] * total[0] > CANCELLED * largest * largest and not cancels(x, cosines, exact):
        for i in range(n):
            weights[places[i]] = quotient(at(v, i), total, exact)[0]
    return CAUTION * n * EPSILON * sizes > unit * smallest * abs(total[0])


@strict_device
def _newton_step(cosines: Floats, beta: Floats, matrix: Floats, step: Floats) -> float:
    """Write the Newton step of the bargaining problem, in units of beta, to `step`.

    Return the Newton decrement.
    """
    n = beta.size
    slope = np.empty(n)
    for i in range(n):
        inner = 0.0
        for j in range(n):
            inner += cosines[i, j] * beta[j]
            matrix[i, j] = beta[i] * cosines[i, j] * beta[j]
        slope[i] = 1.0 - beta[i] * inner
    solve_shifted(matrix, slope, step)
    square = 0.0
    for i in range(n):
        square += slope[i] * step[i]
    return float(np.sqrt(max(square, 0.0)))


@strict_kernel
def bargain(cosines: Floats, beta: Floats) -> bool:
    """Solve C beta = 1 / beta for beta > 0 by damped Newton steps, with the cosine matrix C.

    Return False if the iteration diverges.

    The objective 1/2 beta^T C beta - sum log beta is self-concordant. Steps of length 1 / (1 +
    decrement) therefore converge from any start. In units of beta, the Hessian is 1 + B C B with B
    = diag(beta). A damped step therefore never makes an element of beta zero. If some sum of the
    directions with non-negative weights is zero, beta grows without limit.

    Args:
        cosines: [n, n] cosines C of the gradients.
        beta: [n] output, the solution.
    """
    n = beta.size
    total = cosines.sum()
    beta[:] = np.sqrt(n / total) if total > 1.0 else 1.0
    matrix, step = np.empty((n, n)), np.empty(n)
    last = np.inf
    for _ in range(STEPS):
        decrement = _newton_step(cosines, beta, matrix, step)
        damping = 1.0 / (1.0 + decrement) if decrement > CLOSE else 1.0
        for i in range(n):
            beta[i] *= 1.0 + damping * step[i]
        if beta.max() > ENDLESS:
            return False
        # After each full step, the decrement is about the square of the previous decrement, until
        # rounding ends the convergence.
        if decrement <= DECREMENT or decrement > 0.5 * last:
            return True
        last = decrement if decrement <= CLOSE else np.inf
    return False


@strict_part
def _polish(cosines: Pairs, beta: Floats) -> None:
    """Apply Newton steps with 32-digit slopes, until 16 digits of beta are correct."""
    n = beta.size
    matrix, slope, step, pairs = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros((n, 2))
    last = np.inf
    for _ in range(POLISHING):
        pairs[:, 0] = beta
        for i in range(n):
            inner = product(products(cosines[i], pairs, 0, n, True), at(pairs, i), True)
            slope[i] = minus(ONE, inner, True)[0]
            for j in range(n):
                matrix[i, j] = beta[i] * cosines[i, j, 0] * beta[j]
        solve_shifted(matrix, slope, step)
        size = np.abs(step).max()
        if not size < 0.5 * last:
            return
        last = size
        for i in range(n):
            beta[i] += beta[i] * step[i]


@strict_part
def _bargained(cosines: Pairs, beta: Floats, exact: Exact) -> bool:
    """Write the solution beta [n] of the bargaining problem to `beta`.

    Return False if beta grows without limit.
    """
    n = beta.size
    beta[:] = 1.0
    if n == 2:
        apart = plus(ONE, at(cosines[0], 1), exact)
        if apart[0] < EPSILON:
            apart = (EPSILON, 0.0)
        beta[:] = quotient(ONE, root(apart, exact), exact)[0]
    elif n > 2:
        if not bargain(cosines[:, :, 0].copy(), beta):
            return False
        if exact is not None:
            _polish(cosines, beta)
    return True


@strict_kernel
def geometric_mean(values: Floats) -> float:
    """Return the n-th root of a product of n numbers.

    Overflow, underflow and loss of digits are avoided.
    """
    mantissa, exponent = 1.0, 0
    for value in values:
        fraction, power = math.frexp(value)
        mantissa *= fraction
        exponent += power
    n = values.size
    whole = exponent // n
    # The exponent is split into a multiple of n and a remainder from 0 to n - 1. The root is taken
    # of the mantissa multiplied by the remaining power of two.
    return math.ldexp(math.ldexp(mantissa, exponent - whole * n) ** (1.0 / n), whole)


@strict_kernel
def nash(
    gramians: Floats, rounding_residuals: Floats, present: Flags, unit: float, exact: Exact
) -> Solved:
    """Return the Nash-MTL weights, multiplied by the geometric mean of the gradient norms.

    The weights alpha solve G alpha = 1 / alpha with the Gramian G. `imtl_g` describes the
    arguments and results.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    for b in range(blocks):
        places, norms, cosines = _of_present(gramians[b], rounding_residuals[b], present[b], exact)
        n = places.size
        beta = np.empty(n)
        if n == 0 or not _bargained(cosines, beta, exact):
            continue
        largest = beta.max()
        # The square |u|^2 equals n. Errors of the cosines affect u in proportion to the largest
        # summand, divided by |u|.
        ill_conditioned[b] = n > 1 and CAUTION * n * EPSILON * max(largest / np.sqrt(n), 1.0) > unit
        if n > 1 and n <= CANCELLED * largest * largest:
            continue
        longest = norms[:, 0].max()
        mean = geometric_mean(norms[:, 0] / longest)
        for i in range(n):
            result[b, places[i]] = beta[i] * mean * (longest / norms[i, 0])
    return result, ill_conditioned


@strict_kernel
def aligned(
    gramians: Floats, rounding_residuals: Floats, present: Flags, unit: float, exact: Exact
) -> Solved:
    """Return the weights sqrt(l_min) V L^-1/2 V^T p with p = 1/K and the Gramian G = V L V^T.

    `imtl_g` describes the arguments and results.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    for b in range(blocks):
        places, norms, cosines = _of_present(gramians[b], rounding_residuals[b], present[b], exact)
        n = places.size
        if n == 0:
            continue
        # The eigenvalues of D C D and of C have equal relative errors.
        pivot = smallest_pivot(cosines[:, :, 0].copy(), n)
        ill_conditioned[b] = n > 1 and CAUTION * n * EPSILON > unit * pivot
        matrix, vectors = _graded(norms, cosines, exact), np.empty((n, n, 2))
        values = eigen(matrix, vectors, exact)
        floor = n * EPSILON * values.max()
        if n == 2 and 1.0 + cosines[0, 1, 0] <= OPPOSITE:
            floor = values.min()
        kept = np.flatnonzero(values > floor)
        least = kept[np.argmin(values[kept])]
        ones, w = np.zeros((n, 2)), np.zeros((n, 2))
        ones[:, 0] = 1.0
        for i in kept:
            inner = products(vectors[:, i], ones, 0, n, exact)
            # Skip eigenvectors that are orthogonal to p, because such eigenvectors would add only
            # rounding noise.
            if abs(inner[0]) > OPPOSITE:
                ratio = quotient(at(matrix[least], least), at(matrix[i], i), exact)
                factor = product(root(ratio, exact), inner, exact)
                _add(w, quotient(factor, (float(views), 0.0), exact), vectors[:, i], exact)
        for i in range(n):
            result[b, places[i]] = w[i, 0]
    return result, ill_conditioned
