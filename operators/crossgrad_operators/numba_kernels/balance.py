"""Equal projections and bargaining (IMTL-G, Nash-MTL), and equal singular values (Aligned-MTL).

Each kernel also says for which blocks rounding of the Gramian itself may show in the result:
`exact_balance` has the same methods with twice the digits.
"""

import math

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part
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
    form,
    normalised,
)

#: Newton steps of Nash-MTL at most; about ten are usual.
STEPS = 200
#: Newton decrement at which they end.
DECREMENT = 1e-13
#: Newton decrement below which whole steps converge quadratically.
CLOSE = 0.25
#: A beta beyond which a bargain has no end: 7e5 sqrt(K) is already zero by `CANCELLED`.
ENDLESS = 3e7


@strict_part
def _compact(
    gramian: Floats, present: Flags, norms: Floats, cosines: Floats, places: Indices
) -> int:
    """Norms and cosines of the present views only, at the front; returns their number."""
    views = present.size
    all_norms, all_cosines = np.empty(views), np.empty((views, views))
    normalised(gramian, present, all_norms, all_cosines)
    count = 0
    for k in range(views):
        if present[k]:
            places[count] = k
            count += 1
    for i in range(count):
        norms[i] = all_norms[places[i]]
        for j in range(count):
            cosines[i, j] = all_cosines[places[i], places[j]]
    return count


@strict_part
def _shortest_solution(norms: Floats, cosines: Floats, rank: int) -> Floats:
    """The shortest v with least |G v - (|g_k|)| for G of the given rank below full."""
    n = norms.size
    # G = D C D has the rank of C, which its own eigenvalues would not show at large norm ratios.
    gramian, vectors = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            gramian[i, j] = norms[i] * cosines[i, j] * norms[j]
    values = eigen(gramian, vectors)
    order = np.argsort(values)
    v = np.zeros(n)
    for place in range(n - rank, n):
        i = order[place]
        inner, size = 0.0, 0.0
        for k in range(n):
            inner += vectors[k, i] * norms[k]
            size += abs(vectors[k, i]) * norms[k]
        # An eigenvector at right angles to the norms contributes nothing, not its rounding noise.
        if abs(inner) > OPPOSITE * size:
            for k in range(n):
                v[k] += inner / values[i] * vectors[k, i]
    return v


@strict_part
def _equal_projections(norms: Floats, cosines: Floats, v: Floats) -> float:
    """Solves G v = (|g_k|); the shortest least-squares solution where G is singular.

    Returns:
        The smallest eigenvalue of the cosines over the largest one.
    """
    n = norms.size
    vectors = np.empty((n, n))
    values = eigen(cosines.copy(), vectors)
    rank = 0
    for i in range(n):
        rank += values[i] > OPPOSITE * values.max()
    if rank == n:
        solve(cosines, np.arange(n), n, np.ones(n), v)
        v[:] = v / norms
    else:
        v[:] = _shortest_solution(norms, cosines, rank)
    smallest: float = values.min() / values.max()
    return smallest


@strict_device
def _cancels(v: Floats, norms: Floats, cosines: Floats) -> bool:
    """Whether the v, or the gradients times v, add up to no more than their rounding noise."""
    total, longest = v.sum(), np.abs(v).max()
    if total * total <= CANCELLED * longest * longest:
        return True
    x = v * norms
    longest = np.abs(x).max()
    return bool(form(x, cosines, x) <= CANCELLED * longest * longest)


@strict_kernel
def imtl_g(gramians: Floats, present: Flags, unit: float) -> tuple[Floats, Flags]:
    """Weights that add up to 1 and give u equal projections on all unit gradients.

    Args:
        gramians: [B, K, K].
        present: [B, K].
        unit: Relative error from which a result is doubtful.

    Returns:
        [B, K] weights and [B] whether they are doubtful.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    norms, cosines = np.empty(views), np.empty((views, views))
    places = np.empty(views, np.int64)
    for b in range(blocks):
        n = _compact(gramians[b], present[b], norms, cosines, places)
        if n == 0:
            continue
        if n <= 2:
            total = norms[:n].sum()
            for i in range(n):
                result[b, places[i]] = 1.0 if n == 1 else norms[1 - i] / total
            if n == 2 and 1.0 + cosines[0, 1] <= OPPOSITE:
                result[b] = 0.0
            continue
        scaled, own = norms[:n] / norms[:n].max(), cosines[:n, :n].copy()
        v = np.empty(n)
        smallest = _equal_projections(scaled, own, v)
        total, sizes = v.sum(), np.abs(v).sum()
        ill_conditioned[b] = CAUTION * n * EPSILON * sizes > unit * smallest * abs(total)
        if not _cancels(v, scaled, own):
            for i in range(n):
                result[b, places[i]] = v[i] / total
    return result, ill_conditioned


@strict_device
def _newton_step(cosines: Floats, beta: Floats, matrix: Floats, step: Floats) -> float:
    """Newton's step of the bargain in units of beta, and its decrement."""
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
    """Solves C beta = 1 / beta for beta > 0 by damped Newton; False where there is no such beta.

    The objective 1/2 beta^T C beta - sum log beta is self-concordant, so that steps of
    1 / (1 + decrement) converge from anywhere. In units of beta the Hessian is 1 + B C B, so that
    no damped step takes a whole beta. Where a sum of directions without a negative weight vanishes,
    beta grows without end.

    Args:
        cosines: [n, n].
        beta: [n] solution.
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
        # After a whole step the decrement squares itself, until rounding stops it.
        if decrement <= DECREMENT or decrement > 0.5 * last:
            return True
        last = decrement if decrement <= CLOSE else np.inf
    return False


@strict_kernel
def geometric_mean(values: Floats) -> float:
    """The n-th root of a product, with the exponents apart so that it neither fades nor loses."""
    mantissa, exponent = 1.0, 0
    for value in values:
        part, power = math.frexp(value)
        mantissa *= part
        exponent += power
    n = values.size
    whole = exponent // n
    # The rest of the exponent, from 0 to n - 1, goes under the root.
    return math.ldexp(math.ldexp(mantissa, exponent - whole * n) ** (1.0 / n), whole)


@strict_kernel
def nash(gramians: Floats, present: Flags, unit: float) -> tuple[Floats, Flags]:
    """Weights alpha with G alpha = 1 / alpha, times the geometric mean of the norms.

    Args:
        gramians: [B, K, K].
        present: [B, K].
        unit: Relative error from which a result is doubtful.

    Returns:
        [B, K] weights and [B] whether they are doubtful.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    norms, cosines = np.empty(views), np.empty((views, views))
    places = np.empty(views, np.int64)
    for b in range(blocks):
        n = _compact(gramians[b], present[b], norms, cosines, places)
        if n == 0:
            continue
        beta = np.ones(n)
        if n == 2:
            beta[:] = 1.0 / np.sqrt(max(1.0 + cosines[0, 1], EPSILON))
        elif n > 2 and not bargain(cosines[:n, :n].copy(), beta):
            continue
        largest = beta.max()
        # |u|^2 is n, and errors of the cosines grow with the summands over |u|.
        ill_conditioned[b] = n > 1 and CAUTION * n * EPSILON * max(largest / np.sqrt(n), 1.0) > unit
        if n > 1 and n <= CANCELLED * largest * largest:
            continue
        longest = norms[:n].max()
        mean = geometric_mean(norms[:n] / longest)
        for i in range(n):
            result[b, places[i]] = beta[i] * mean * (longest / norms[i])
    return result, ill_conditioned


@strict_kernel
def aligned(gramians: Floats, present: Flags, unit: float) -> tuple[Floats, Flags]:
    """Weights sqrt(l_min) V L^-1/2 V^T p with p = 1/K and G = V L V^T.

    Args:
        gramians: [B, K, K].
        present: [B, K].
        unit: Relative error from which a result is doubtful.

    Returns:
        [B, K] weights and [B] whether they are doubtful.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    norms, cosines = np.empty(views), np.empty((views, views))
    places = np.empty(views, np.int64)
    for b in range(blocks):
        n = _compact(gramians[b], present[b], norms, cosines, places)
        if n == 0:
            continue
        # Eigenvalues of D C D have the relative errors of those of C.
        ill_conditioned[b] = n > 1 and CAUTION * n * EPSILON > unit * smallest_pivot(cosines, n)
        longest = norms[:n].max()
        gramian, vectors = np.empty((n, n)), np.empty((n, n))
        for i in range(n):
            for j in range(n):
                gramian[i, j] = (norms[i] / longest) * cosines[i, j] * (norms[j] / longest)
        values = eigen(gramian, vectors)
        floor = n * EPSILON * values.max()
        if n == 2 and 1.0 + cosines[0, 1] <= OPPOSITE:
            floor = values.min()
        smallest = np.inf
        for i in range(n):
            if values[i] > floor:
                smallest = min(smallest, values[i])
        for i in range(n):
            inner = vectors[:, i].sum()
            # An eigenvector at right angles to p contributes nothing, not its rounding noise.
            if values[i] > floor and abs(inner) > OPPOSITE:
                factor = np.sqrt(smallest / values[i]) * inner / views
                for k in range(n):
                    result[b, places[k]] += factor * vectors[k, i]
    return result, ill_conditioned
