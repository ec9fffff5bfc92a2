"""Equal projections and bargaining (IMTL-G, Nash-MTL), and equal singular values (Aligned-MTL)."""

import math

import numpy as np
from numba import njit

from crossgrad_operators.numba_kernels.linear import eigen, solve
from crossgrad_operators.numba_kernels.normal import (
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
EPSILON = 2.220446049250313e-16


@njit(cache=True)
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


@njit(cache=True)
def _noise(x: Floats, cosines: Floats) -> bool:
    largest = np.abs(x).max()
    return bool(form(x, cosines, x) <= 2.0 * OPPOSITE * largest * largest)


@njit(cache=True)
def _equal_projections(norms: Floats, cosines: Floats) -> Floats:
    """Solves G v = (|g_k|); the shortest least-squares solution where G is singular."""
    n = norms.size
    vectors = np.empty((n, n))
    values = eigen(cosines.copy(), vectors)
    rank = 0
    for i in range(n):
        rank += values[i] > OPPOSITE * values.max()
    v = np.zeros(n)
    if rank == n:
        solve(cosines, np.arange(n), n, np.ones(n), v)
        return v / norms
    # G = D C D has the rank of C, which its own eigenvalues would not show at large norm ratios.
    gramian = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            gramian[i, j] = norms[i] * cosines[i, j] * norms[j]
    values = eigen(gramian, vectors)
    order = np.argsort(values)
    for place in range(n - rank, n):
        i = order[place]
        inner = 0.0
        for k in range(n):
            inner += vectors[k, i] * norms[k]
        for k in range(n):
            v[k] += inner / values[i] * vectors[k, i]
    return v


@njit(cache=True)
def imtl_g(gramians: Floats, present: Flags) -> Floats:
    """[B, K] weights, adding up to 1, that give u equal projections on all unit gradients."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
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
        scaled = norms[:n] / norms[:n].max()
        v = _equal_projections(scaled, cosines[:n, :n].copy())
        total = v.sum()
        if abs(total) <= OPPOSITE * np.abs(v).sum():
            continue
        if not _noise(v * scaled, cosines[:n, :n]):
            for i in range(n):
                result[b, places[i]] = v[i] / total
    return result


@njit(cache=True)
def _bargain(cosines: Floats) -> Floats:
    """Solves C beta = 1 / beta for beta > 0 by damped Newton.

    The objective 1/2 beta^T C beta - sum log beta is self-concordant, so that steps of
    1 / (1 + decrement) converge from anywhere.
    """
    n = cosines.shape[0]
    beta = np.full(n, 1.0 / np.sqrt(cosines.sum() / n)) if cosines.sum() > 0.5 else np.ones(n)
    everyone = np.arange(n)
    matrix = np.empty((n, n))
    right, step = np.empty(n), np.zeros(n)
    last = np.inf
    for _ in range(STEPS):
        # In units of beta the Hessian is B C B + 1, whose unit diagonal plus one never degenerates.
        for i in range(n):
            inner = 0.0
            for j in range(n):
                inner += cosines[i, j] * beta[j]
                matrix[i, j] = beta[i] * cosines[i, j] * beta[j]
            matrix[i, i] += 1.0
            right[i] = 1.0 - beta[i] * inner
        solve(matrix, everyone, n, right, step)
        decrement = 0.0
        for i in range(n):
            decrement += right[i] * step[i]
        decrement = np.sqrt(max(decrement, 0.0))
        damping = 1.0 / (1.0 + decrement) if decrement > 0.25 else 1.0
        for i in range(n):
            beta[i] *= 1.0 + damping * step[i]
        # Close to the minimum the decrement squares itself, until rounding stops it.
        stuck = decrement <= 0.25 and decrement > 0.5 * last
        if decrement <= DECREMENT or stuck or beta.max() > 1e8:
            break
        last = decrement
    return beta


@njit(cache=True)
def _geometric_mean(values: Floats) -> float:
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


@njit(cache=True)
def nash(gramians: Floats, present: Flags) -> Floats:
    """[B, K] weights alpha with G alpha = 1 / alpha, times the geometric mean of the norms."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    places = np.empty(views, np.int64)
    for b in range(blocks):
        n = _compact(gramians[b], present[b], norms, cosines, places)
        if n == 0:
            continue
        if n <= 2:
            apart = 0.0 if n == 1 else cosines[0, 1]
            beta = np.full(n, 1.0 / np.sqrt(max(1.0 + apart, EPSILON)))
        else:
            beta = _bargain(cosines[:n, :n].copy())
        # |u|^2 = n exactly; a small share of |beta|^2 means that nothing but noise is left.
        if n > 1 and n <= 2.0 * OPPOSITE * beta.max() * beta.max():
            continue
        longest = norms[:n].max()
        mean = _geometric_mean(norms[:n] / longest)
        for i in range(n):
            result[b, places[i]] = beta[i] * mean * (longest / norms[i])
    return result


@njit(cache=True)
def aligned(gramians: Floats, present: Flags) -> Floats:
    """[B, K] weights sqrt(l_min) V L^-1/2 V^T p with p = 1/K and G = V L V^T."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    places = np.empty(views, np.int64)
    for b in range(blocks):
        n = _compact(gramians[b], present[b], norms, cosines, places)
        if n == 0:
            continue
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
    return result
