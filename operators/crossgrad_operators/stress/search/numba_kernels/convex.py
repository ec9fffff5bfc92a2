"""UPGrad, DualProj, MGDA and CAGrad in 32 digits: projections on cones and simplices.

All are complementarity problems in the cosines C of the present gradients. Each kernel takes norms
[B, K, 2], cosines [B, K, K, 2] and present [B, K], and returns weights [B, K, 2] and trust [B]: the
smallest pivot of the systems that were solved, or -1 where no solution was found.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_kernel
from crossgrad_operators.stress.search.numba_kernels.doubled import (
    Flags,
    Floats,
    Pair,
    add,
    at,
    divide,
    entry,
    inner,
    minus,
    multiply,
    root,
)
from crossgrad_operators.stress.search.numba_kernels.linear import (
    complementary,
    dot,
    form,
    largest,
    negated,
)

Solved: TypeAlias = tuple[Floats, NDArray[np.float64]]

#: What exactly opposite directions leave, as a share of the largest coefficient squared.
NOISE = 2e-12
#: Steps of CAGrad's one-dimensional search.
STEPS = 60


@inner
def _is_noise(cosines: Floats, x: Floats) -> bool:
    size = largest(x)
    return form(cosines, x)[0] <= NOISE * size * size


@inner
def _times(matrix: Floats, x: Floats, out: Floats) -> None:
    for k in range(x.shape[0]):
        out[k, 0], out[k, 1] = dot(matrix[k], x)


@inner
def _projection(cosines: Floats, b: Floats, present: Flags, z: Floats) -> float:
    """Coefficients z of the projection of sum b_k e_k on {x: x.e_l >= 0}; zero where noise."""
    offset = np.empty((b.shape[0], 2))
    _times(cosines, b, offset)
    trust = complementary(cosines, offset, present, z)
    for k in range(b.shape[0]):
        z[k, 0], z[k, 1] = add(at(z, k), at(b, k))
    if _is_noise(cosines, z):
        z[:] = 0.0
    return trust


@strict_kernel
def on_cone(norms_of: Floats, cosines_of: Floats, present: Flags, apart: bool) -> Solved:
    """Each gradient projected (UPGrad), or all at once (DualProj), over K."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    b, z = np.empty((views, 2)), np.empty((views, 2))
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        unit = largest(norms)
        for turn in range(views if apart else 1):
            if unit == 0.0 or (apart and not present[block, turn]):
                continue
            for k in range(views):
                b[k, 0], b[k, 1] = divide(at(norms, k), (unit, 0.0))
                if apart and k != turn:
                    b[k, 0], b[k, 1] = 0.0, 0.0
            trust[block] = min(trust[block], _projection(cosines, b, present[block], z))
            for i in range(views):
                if z[i, 0] != 0.0:
                    length = divide((unit, 0.0), multiply(at(norms, i), (float(views), 0.0)))
                    value = add(at(weights[block], i), multiply(at(z, i), length))
                    weights[block, i, 0], weights[block, i, 1] = value
    return weights, trust


@inner
def _reciprocals(norms: Floats, present: Flags, r: Floats) -> int:
    """Fills r_k = s / |g_k|, s the smallest norm; returns the number of present views."""
    shortest, count = np.inf, 0
    for k in range(norms.shape[0]):
        if present[k]:
            shortest = min(shortest, norms[k, 0])
            count += 1
    r[:] = 0.0
    for k in range(norms.shape[0]):
        if present[k]:
            r[k, 0], r[k, 1] = divide((shortest, 0.0), at(norms, k))
    return count


@inner
def _shortest(cosines: Floats, r: Floats, present: Flags, x: Floats) -> float:
    """The shortest sum of x_k e_k with x >= 0 and r.x = 1.

    It is parallel to the minimum of |sum x_k e_k|^2 + (r.x - 1)^2, a problem without the equation.
    """
    views = r.shape[0]
    matrix = np.empty((views, views, 2))
    for i in range(views):
        for j in range(views):
            value = add(entry(cosines, i, j), multiply(at(r, i), at(r, j)))
            matrix[i, j, 0], matrix[i, j, 1] = value
    trust = complementary(matrix, negated(r), present, x)
    total = dot(r, x)
    for k in range(views):
        x[k, 0], x[k, 1] = divide(at(x, k), total)
    return trust


@inner
def _lowest(q: Floats, r: Floats, present: Flags) -> int:
    """The view that g_0 serves worst."""
    lowest = -1
    for k in range(r.shape[0]):
        if present[k] and (lowest < 0 or q[k, 0] / r[k, 0] < q[lowest, 0] / r[lowest, 0]):
            lowest = k
    return lowest


@inner
def _worst_off(
    cosines: Floats, r: Floats, q: Floats, rho: Pair, present: Flags, y: Floats, vanishes: bool
) -> float:
    """Coefficients y >= 0 of the v = sum y_k e_k, |v| = rho, that raises min_k g_k.(g_0 + v) most.

    The least |v| with which all views reach a level is convex in the level, with the slope
    r.y / |v|: Newton's method meets rho from above. y = 0 where directions that cancel let v be
    anything.
    """
    views = r.shape[0]
    offset = np.empty((views, 2))
    level = (0.0, 0.0)
    last = np.inf
    for step in range(STEPS):
        for k in range(views):
            value = add(at(q, k), minus(multiply(level, at(r, k))))
            offset[k, 0], offset[k, 1] = value
        trust = complementary(cosines, offset, present, y)
        if trust < 0.0:
            return trust
        length = root(form(cosines, y))
        gap = add(length, minus(rho))
        if vanishes and step == 0 and gap[0] <= 0.0:
            y[:] = 0.0
            return trust
        if abs(gap[0]) <= 1e-28 * rho[0] or (step > 1 and abs(gap[0]) >= last):
            return trust if abs(gap[0]) <= 1e-20 * rho[0] else -1.0
        last = abs(gap[0])
        if length[0] > 0.0:
            level = add(level, minus(divide(multiply(gap, length), dot(r, y))))
        else:
            k = _lowest(q, r, present)
            level = divide(add(rho, at(q, k)), at(r, k))
    return -1.0


@strict_kernel
def on_simplex(norms_of: Floats, cosines_of: Floats, present: Flags, c: float) -> Solved:
    """CAGrad: g_0 + v with v the best of length c |g_0|; MGDA for c < 0; zero where it is noise."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    r, q, x = np.empty((views, 2)), np.empty((views, 2)), np.empty((views, 2))
    lengths, y = np.empty((views, 2)), np.zeros((views, 2))
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        count = _reciprocals(norms, present[block], r)
        if count == 0:
            continue
        trust[block] = _shortest(cosines, r, present[block], x)
        vanishes = _is_noise(cosines, x)
        if c < 0.0:
            for k in range(views):
                if not vanishes:
                    weights[block, k, 0], weights[block, k, 1] = multiply(at(x, k), at(r, k))
            continue
        unit = multiply((largest(norms), 0.0), (float(count), 0.0))
        for k in range(views):
            lengths[k, 0], lengths[k, 1] = divide(at(norms, k), unit)
            y[k, 0], y[k, 1] = 0.0, 0.0
        _times(cosines, lengths, q)
        rho = multiply((c, 0.0), root(form(cosines, lengths)))
        if count > 1 and rho[0] > 0.0:
            found = _worst_off(cosines, r, q, rho, present[block], y, vanishes)
            trust[block] = min(trust[block], found)
            if vanishes and _is_noise(cosines, y):
                continue
        for k in range(views):
            if present[block, k]:
                total = add(at(lengths, k), at(y, k))
                length = divide(unit, multiply(at(norms, k), (float(views), 0.0)))
                weights[block, k, 0], weights[block, k, 1] = multiply(total, length)
    return weights, trust
