"""Nash-MTL, IMTL-G and Aligned-MTL in 32 digits."""

import numpy as np

from crossgrad_core.jit import strict_kernel, strict_part
from crossgrad_core.stress.search.numba_kernels.convex import NOISE, Solved
from crossgrad_core.stress.search.numba_kernels.doubled import (
    Flags,
    Floats,
    Pair,
    add,
    at,
    divide,
    entry,
    minus,
    multiply,
    root,
)
from crossgrad_core.stress.search.numba_kernels.linear import (
    dot,
    largest,
    places,
    solve,
)

#: Steps of Newton's method.
STEPS = 400
#: Coefficients above this belong to directions that cancel.
UNBOUNDED = 1e9
#: 1 + cos up to which two directions are exactly opposite; sums of eigenvectors that are zero.
OPPOSITE = 1e-12
#: Sweeps of Jacobi's method.
SWEEPS = 40
EPSILON = 2.220446049250313e-16
#: Share of the largest eigenvalue that is nothing, before it is too small to be divided by.
NEGLIGIBLE = 1e-100


@strict_part
def _bargain(cosines: Floats, present: Flags, beta: Floats) -> bool:
    """C beta = 1 / beta for beta > 0 by damped Newton in log beta; False if it does not end."""
    views = beta.shape[0]
    members = places(present)
    matrix, right = np.zeros((views, views, 2)), np.zeros((views, 2))
    step = np.zeros((views, 2))
    beta[:] = 0.0
    for k in members:
        beta[k, 0] = 1.0
    last = np.inf
    for _ in range(STEPS):
        for i in members:
            for j in members:
                value = multiply(multiply(at(beta, i), entry(cosines, i, j)), at(beta, j))
                value = add(value, (1.0 if i == j else 0.0, 0.0))
                matrix[i, j, 0], matrix[i, j, 1] = value
            value = add((1.0, 0.0), minus(multiply(at(beta, i), dot(cosines[i], beta))))
            right[i, 0], right[i, 1] = value
        solve(matrix, members, members.size, right, step)
        decrement = np.sqrt(max(dot(right, step)[0], 0.0))
        damping = 1.0 if decrement < 0.25 else 1.0 / (1.0 + decrement)
        for k in members:
            factor = add((1.0, 0.0), multiply((damping, 0.0), at(step, k)))
            beta[k, 0], beta[k, 1] = multiply(at(beta, k), factor)
        if decrement <= 1e-28 or largest(beta) > UNBOUNDED:
            return True
        if decrement < 1e-15 and decrement >= last:
            return True
        last = decrement
    return False


@strict_part
def _geometric_mean(norms: Floats, present: Flags) -> Pair:
    """The n-th root of a product of norms."""
    members = places(present)
    logs = 0.0
    for k in members:
        logs += np.log(norms[k, 0])
    mean = (np.exp(logs / members.size), 0.0)
    ratio = (1.0, 0.0)
    for k in members:
        ratio = multiply(ratio, divide(at(norms, k), mean))
    # One step of Newton's method: the first approximation is good to 15 digits.
    rest = divide(add(ratio, (-1.0, 0.0)), (float(members.size), 0.0))
    return multiply(mean, add((1.0, 0.0), rest))


@strict_kernel
def nash(norms_of: Floats, cosines_of: Floats, present: Flags) -> Solved:
    """Bargaining weights times the geometric mean of the norms."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    beta = np.zeros((views, 2))
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        count = places(present[block]).size
        if count == 0:
            continue
        if not _bargain(cosines, present[block], beta):
            trust[block] = -1.0
        if count > 1 and count <= NOISE * largest(beta) ** 2:
            continue
        mean = _geometric_mean(norms, present[block])
        for k in range(views):
            if present[block, k]:
                value = multiply(at(beta, k), divide(mean, at(norms, k)))
                weights[block, k, 0], weights[block, k, 1] = value
    return weights, trust


@strict_kernel
def imtl_g(norms_of: Floats, cosines_of: Floats, present: Flags) -> Solved:
    """Equal projections on all unit gradients, for gradients that are independent."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    v, ones = np.zeros((views, 2)), np.zeros((views, 2))
    ones[:, 0] = 1.0
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        members = places(present[block])
        if members.size == 0:
            continue
        longest = largest(norms)
        if members.size == 2 and 1.0 + cosines[members[0], members[1], 0] <= OPPOSITE:
            continue
        if members.size == 2:
            v[:] = 0.0
            for k in members:
                v[k, 0] = 1.0
        else:
            trust[block] = solve(cosines, members, members.size, ones, v)
            if trust[block] <= OPPOSITE * members.size:
                trust[block] = -1.0
        total = (0.0, 0.0)
        for k in members:
            value = divide(multiply(at(v, k), (longest, 0.0)), at(norms, k))
            v[k, 0], v[k, 1] = value
            total = add(total, value)
        if total[0] ** 2 <= NOISE * largest(v) ** 2:
            continue
        for k in members:
            weights[block, k, 0], weights[block, k, 1] = divide(at(v, k), total)
    return weights, trust


@strict_part
def _eigen(matrix: Floats, vectors: Floats) -> None:
    """Jacobi's method: the matrix [n, n, 2] becomes diagonal, vectors [n, n, 2] are columns."""
    n = matrix.shape[0]
    vectors[:] = 0.0
    for i in range(n):
        vectors[i, i, 0] = 1.0
    least = 0.0
    for i in range(n):
        least = max(least, NEGLIGIBLE * matrix[i, i, 0])
    for _ in range(SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                size = np.sqrt(max(matrix[p, p, 0], 0.0)) * np.sqrt(max(matrix[q, q, 0], 0.0))
                if abs(matrix[p, q, 0]) <= max(1e-31 * size, least):
                    matrix[p, q] = 0.0
                    matrix[q, p] = 0.0
                    continue
                rotated = True
                _rotate(matrix, vectors, p, q)
        if not rotated:
            break


@strict_part
def _rotate(matrix: Floats, vectors: Floats, p: int, q: int) -> None:
    """Makes the entry p, q zero."""
    one, apq = (1.0, 0.0), entry(matrix, p, q)
    gap = add(entry(matrix, q, q), minus(entry(matrix, p, p)))
    theta = divide(gap, multiply((2.0, 0.0), apq))
    if abs(theta[0]) > 1e70:
        t = divide((0.5, 0.0), theta)
    else:
        length = root(add(multiply(theta, theta), one))
        size = theta if theta[0] >= 0.0 else minus(theta)
        t = divide(one if theta[0] >= 0.0 else (-1.0, 0.0), add(size, length))
    c = divide(one, root(add(multiply(t, t), one)))
    s = multiply(t, c)
    moved = multiply(t, apq)
    matrix[p, p, 0], matrix[p, p, 1] = add(entry(matrix, p, p), minus(moved))
    matrix[q, q, 0], matrix[q, q, 1] = add(entry(matrix, q, q), moved)
    matrix[p, q] = 0.0
    matrix[q, p] = 0.0
    for k in range(matrix.shape[0]):
        if k not in (p, q):
            one_side, other = entry(matrix, k, p), entry(matrix, k, q)
            value = add(multiply(c, one_side), minus(multiply(s, other)))
            matrix[k, p, 0], matrix[k, p, 1] = value
            matrix[p, k, 0], matrix[p, k, 1] = value
            value = add(multiply(s, one_side), multiply(c, other))
            matrix[k, q, 0], matrix[k, q, 1] = value
            matrix[q, k, 0], matrix[q, k, 1] = value
        one_side, other = entry(vectors, k, p), entry(vectors, k, q)
        value = add(multiply(c, one_side), minus(multiply(s, other)))
        vectors[k, p, 0], vectors[k, p, 1] = value
        value = add(multiply(s, one_side), multiply(c, other))
        vectors[k, q, 0], vectors[k, q, 1] = value


@strict_kernel
def aligned(norms_of: Floats, cosines_of: Floats, present: Flags) -> Solved:
    """sqrt(l_min) V L^-1/2 V^T p with eigenvalues above n eps l_max."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        members = places(present[block])
        n = members.size
        if n == 0:
            continue
        longest = (largest(norms), 0.0)
        matrix, vectors = np.empty((n, n, 2)), np.empty((n, n, 2))
        for i in range(n):
            for j in range(n):
                one = divide(at(norms, members[i]), longest)
                other = divide(at(norms, members[j]), longest)
                value = multiply(multiply(one, entry(cosines, members[i], members[j])), other)
                matrix[i, j, 0], matrix[i, j, 1] = value
        _eigen(matrix, vectors)
        trust[block] = _levelled(matrix, vectors, cosines, members, weights[block])
    return weights, trust


@strict_part
def _levelled(
    matrix: Floats, vectors: Floats, cosines: Floats, members: Floats, weights: Floats
) -> float:
    """Weights from eigenvalues on the diagonal and eigenvectors; returns the trust in them."""
    n, views = members.size, weights.shape[0]
    top = 0.0
    for i in range(n):
        top = max(top, matrix[i, i, 0])
    floor = n * EPSILON * top
    if n == 2 and 1.0 + cosines[members[0], members[1], 0] <= OPPOSITE:
        floor = min(matrix[0, 0, 0], matrix[1, 1, 0])
    lowest = -1
    for i in range(n):
        if matrix[i, i, 0] > floor and (lowest < 0 or matrix[i, i, 0] < matrix[lowest, lowest, 0]):
            lowest = i
    for i in range(n):
        inner = (0.0, 0.0)
        for k in range(n):
            inner = add(inner, entry(vectors, k, i))
        if matrix[i, i, 0] > floor and abs(inner[0]) > OPPOSITE:
            ratio = root(divide(entry(matrix, lowest, lowest), entry(matrix, i, i)))
            factor = divide(multiply(ratio, inner), (float(views), 0.0))
            for k in range(n):
                value = add(at(weights, members[k]), multiply(factor, entry(vectors, k, i)))
                weights[members[k], 0], weights[members[k], 1] = value
    return 1.0
