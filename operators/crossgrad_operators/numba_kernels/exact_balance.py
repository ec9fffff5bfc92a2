"""The methods of `balance` from Gramians with twice the digits, for what rounding would spoil."""

import numpy as np

from crossgrad_core.numerics.double_double import add, divide, multiply, square_root
from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part
from crossgrad_operators.numba_kernels.balance import bargain, geometric_mean
from crossgrad_operators.numba_kernels.exact_linear import (
    exact_cosines,
    exact_eigen,
    exact_form,
    graded,
    inner,
)
from crossgrad_operators.numba_kernels.linear import solve_shifted
from crossgrad_operators.numba_kernels.normal import CANCELLED, EPSILON, OPPOSITE, Flags, Floats

#: Newton steps at most that follow those in float64; two are enough unless kappa is above 1e5.
POLISHING = 20


@strict_part
def _polish(cosines: Floats, beta: Floats) -> None:
    """Newton steps of the bargain with exact slopes: C beta = 1 / beta to the last digits."""
    n = beta.size
    matrix, slope, step, zeros = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
    last = np.inf
    for _ in range(POLISHING):
        for i in range(n):
            x, x_low = inner(cosines[0, i], cosines[1, i], beta, zeros)
            x, x_low = multiply(x, x_low, beta[i], 0.0)
            slope[i], _ = add(1.0, 0.0, -x, -x_low)
            for j in range(n):
                matrix[i, j] = beta[i] * cosines[0, i, j] * beta[j]
        solve_shifted(matrix, slope, step)
        size = np.abs(step).max()
        if not size < 0.5 * last:
            return
        last = size
        for i in range(n):
            beta[i] += beta[i] * step[i]


@strict_device
def _pair(cosine: float, cosine_low: float) -> float:
    """The beta of two directions, 1 / sqrt(1 + cos); infinite where they are opposite."""
    apart, apart_low = add(1.0, 0.0, cosine, cosine_low)
    if apart <= 0.0:
        return np.inf
    root, root_low = square_root(apart, apart_low)
    return divide(1.0, 0.0, root, root_low)[0]


@strict_kernel
def exact_nash(gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
    """[B, K] weights of `balance.nash`."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    for b in range(blocks):
        places = np.flatnonzero(present[b])
        n = places.size
        if n == 0:
            continue
        norms, cosines = exact_cosines(gramians[b], rounding_residuals[b], places)
        beta = np.ones(n)
        if n == 2:
            beta[:] = _pair(cosines[0, 0, 1], cosines[1, 0, 1])
        elif n > 2:
            if not bargain(cosines[0].copy(), beta):
                continue
            _polish(cosines, beta)
        if n > 1 and n <= CANCELLED * beta.max() * beta.max():
            continue
        longest = norms[0].max()
        mean = geometric_mean(norms[0] / longest)
        for i in range(n):
            result[b, places[i]] = beta[i] * mean * (longest / norms[0, i])
    return result


@strict_part
def _spectral(
    matrix: Floats, vectors: Floats, right: Floats, kept: Flags, power: int, out: Floats
) -> None:
    """Sum of v_i (v_i.r) / l_i over the kept eigenvectors, or over sqrt(l_i) for power 1.

    Eigenvectors at right angles to r contribute nothing, not their rounding noise.
    """
    least = 0.0 if kept.all() and power == 2 else OPPOSITE
    n = matrix.shape[1]
    out[:] = 0.0
    for i in range(n):
        if not kept[i]:
            continue
        x, x_low = inner(vectors[0, :, i], vectors[1, :, i], right[0], right[1])
        size = 1.0 if power == 1 else (np.abs(vectors[0, :, i]) * right[0]).sum()
        if abs(x) <= least * size:
            continue
        value, value_low = matrix[0, i, i], matrix[1, i, i]
        if power == 1:
            value, value_low = square_root(value, value_low)
        x, x_low = divide(x, x_low, value, value_low)
        for k in range(n):
            y, y_low = multiply(x, x_low, vectors[0, k, i], vectors[1, k, i])
            out[0, k], out[1, k] = add(out[0, k], out[1, k], y, y_low)


@strict_part
def _equal_projections(cosines: Floats, norms: Floats, v: Floats) -> None:
    """Solves G v = (|g_k|), or its shortest least-squares solution, for norms in units of one."""
    n = norms.shape[1]
    matrix, vectors = cosines.copy(), np.empty((2, n, n))
    exact_eigen(matrix, vectors)
    values = np.empty(n)
    for i in range(n):
        values[i] = matrix[0, i, i]
    rank = int((values > OPPOSITE * values.max()).sum())
    kept = np.ones(n, np.bool_)
    if rank == n:
        ones = np.zeros((2, n))
        ones[0] = 1.0
        _spectral(matrix, vectors, ones, kept, 2, v)
        for i in range(n):
            v[0, i], v[1, i] = divide(v[0, i], v[1, i], norms[0, i], norms[1, i])
        return
    graded(cosines, norms, matrix)
    exact_eigen(matrix, vectors)
    for i in range(n):
        values[i] = matrix[0, i, i]
    order = np.argsort(values)
    for place in range(n - rank):
        kept[order[place]] = False
    _spectral(matrix, vectors, norms, kept, 2, v)


@strict_part
def _normalised_sum(cosines: Floats, norms: Floats, v: Floats, weights: Floats) -> bool:
    """Weights v / sum v; False where nothing but a pole or noise is left."""
    n = norms.shape[1]
    total, total_low = 0.0, 0.0
    x = np.empty((2, n))
    for i in range(n):
        total, total_low = add(total, total_low, v[0, i], v[1, i])
        x[0, i], x[1, i] = multiply(v[0, i], v[1, i], norms[0, i], norms[1, i])
    longest = np.abs(v[0]).max()
    if total * total <= CANCELLED * longest * longest:
        return False
    longest = np.abs(x[0]).max()
    if exact_form(cosines, x)[0] <= CANCELLED * longest * longest:
        return False
    for i in range(n):
        weights[i] = divide(v[0, i], v[1, i], total, total_low)[0]
    return True


@strict_kernel
def exact_imtl_g(gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
    """[B, K] weights of `balance.imtl_g`, for blocks with more than two gradients."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    for b in range(blocks):
        places = np.flatnonzero(present[b])
        n = places.size
        norms, cosines = exact_cosines(gramians[b], rounding_residuals[b], places)
        scaled, v, weights = np.empty((2, n)), np.empty((2, n)), np.empty(n)
        longest = np.argmax(norms[0])
        for i in range(n):
            share = divide(norms[0, i], norms[1, i], norms[0, longest], norms[1, longest])
            scaled[0, i], scaled[1, i] = share
        _equal_projections(cosines, scaled, v)
        if _normalised_sum(cosines, scaled, v, weights):
            for i in range(n):
                result[b, places[i]] = weights[i]
    return result


@strict_kernel
def exact_aligned(gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
    """[B, K] weights of `balance.aligned`."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    for b in range(blocks):
        places = np.flatnonzero(present[b])
        n = places.size
        if n == 0:
            continue
        norms, cosines = exact_cosines(gramians[b], rounding_residuals[b], places)
        matrix, vectors = np.empty((2, n, n)), np.empty((2, n, n))
        graded(cosines, norms, matrix)
        exact_eigen(matrix, vectors)
        values = np.empty(n)
        for i in range(n):
            values[i] = matrix[0, i, i]
        floor = n * EPSILON * values.max()
        if n == 2 and add(1.0, 0.0, cosines[0, 0, 1], cosines[1, 0, 1])[0] <= OPPOSITE:
            floor = values.min()
        kept = values > floor
        smallest = np.argmin(np.where(kept, values, np.inf))
        root, root_low = square_root(matrix[0, smallest, smallest], matrix[1, smallest, smallest])
        uniform, w = np.zeros((2, n)), np.empty((2, n))
        uniform[0] = 1.0
        _spectral(matrix, vectors, uniform, kept, 1, w)
        for i in range(n):
            x, x_low = multiply(w[0, i], w[1, i], root, root_low)
            result[b, places[i]] = divide(x, x_low, float(views), 0.0)[0]
    return result
