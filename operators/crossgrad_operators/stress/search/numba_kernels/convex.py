"""UPGrad, DualProj, MGDA and CAGrad in 32 digits: projections on cones and simplices.

All are complementarity problems in the cosines C of the present gradients. Each kernel takes norms
[B, K, 2], cosines [B, K, K, 2] and present [B, K], and returns weights [B, K, 2] and trust [B]: the
smallest pivot of the systems that were solved, or -1 where no solution was found.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_kernel, strict_part
from crossgrad_operators.stress.search.numba_kernels.doubled import (
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
from crossgrad_operators.stress.search.numba_kernels.linear import (
    complementary,
    dot,
    form,
    largest,
    negated,
)

Solved: TypeAlias = tuple[Floats, NDArray[np.float64]]

#: What two opposite directions leave, as a share of the largest coefficient squared.
NOISE = 2e-12
#: 1 + cos up to which two directions are opposite.
OPPOSITE = 1e-12
#: What 32 digits leave of a sum of more directions that is zero; up to `UNSURE` it is open.
VANISHED, UNSURE = 1e-28, 1e-24
#: Steps of CAGrad's one-dimensional search.
STEPS = 60


@strict_part
def _is_pair(cosines: Floats) -> bool:
    count = 0
    for k in range(cosines.shape[0]):
        count += int(cosines[k, k, 0] > 0.0)
    return count <= 2


@strict_part
def _zero(cosines: Floats, x: Floats, trust: float) -> tuple[bool, float]:
    """Whether sum x_k e_k is zero, and the trust in that: -1 where these digits do not tell."""
    size = largest(x)
    square, scale = form(cosines, x)[0], size * size
    if _is_pair(cosines):
        return square <= NOISE * scale, trust
    unsure = VANISHED * scale < square <= UNSURE * scale
    return square <= VANISHED * scale, -1.0 if unsure else trust


@strict_part
def _times(matrix: Floats, x: Floats, out: Floats) -> None:
    for k in range(x.shape[0]):
        out[k, 0], out[k, 1] = dot(matrix[k], x)


@strict_part
def _projection(cosines: Floats, b: Floats, present: Flags, z: Floats) -> float:
    """Coefficients z of the projection of sum b_k e_k on {x: x.e_l >= 0}; zero where noise."""
    offset = np.empty((b.shape[0], 2))
    _times(cosines, b, offset)
    trust = complementary(cosines, offset, present, z)
    for k in range(b.shape[0]):
        z[k, 0], z[k, 1] = add(at(z, k), at(b, k))
    zero, trust = _zero(cosines, z, trust)
    if zero:
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


@strict_part
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


@strict_part
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


@strict_part
def _lowest(q: Floats, r: Floats, present: Flags) -> int:
    """The view that g_0 serves worst."""
    lowest = -1
    for k in range(r.shape[0]):
        if present[k] and (lowest < 0 or q[k, 0] / r[k, 0] < q[lowest, 0] / r[lowest, 0]):
            lowest = k
    return lowest


@strict_part
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
        if vanishes and step == 0 and gap[0] < -1e-20 * rho[0]:
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
def shortest(norms_of: Floats, cosines_of: Floats, present: Flags) -> Solved:
    """MGDA: the shortest convex combination."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    r, x = np.empty((views, 2)), np.empty((views, 2))
    for block in range(blocks):
        cosines = cosines_of[block]
        if _reciprocals(norms_of[block], present[block], r) == 0:
            continue
        zero, trust[block] = _zero(cosines, x, _shortest(cosines, r, present[block], x))
        for k in range(views):
            if not zero:
                weights[block, k, 0], weights[block, k, 1] = multiply(at(x, k), at(r, k))
    return weights, trust


@strict_part
def _conflict_averse(
    cosines: Floats, lengths: Floats, r: Floats, present: Flags, c: float, y: Floats
) -> float:
    """Coefficients y of what CAGrad adds to g_0 = sum l_k e_k, or -l where the result is zero."""
    views = r.shape[0]
    q, x = np.empty((views, 2)), np.empty((views, 2))
    zero, trust = _zero(cosines, lengths, _shortest(cosines, r, present, x))
    vanishes, trust = _zero(cosines, x, trust)
    if not zero:
        _times(cosines, lengths, q)
        rho = multiply((c, 0.0), root(form(cosines, lengths)))
        trust = min(trust, _worst_off(cosines, r, q, rho, present, y, vanishes))
        zero, trust = _zero(cosines, y, trust)
    if zero:
        for k in range(views):
            y[k, 0], y[k, 1] = minus(at(lengths, k))
    return trust


@strict_part
def _pair_cosine(cosines: Floats) -> float:
    """The cosine of the only two directions; 1 if there are more."""
    if not _is_pair(cosines):
        return 1.0
    least = 1.0
    for i in range(cosines.shape[0]):
        for j in range(i):
            if cosines[i, i, 0] > 0.0 and cosines[j, j, 0] > 0.0:
                least = cosines[i, j, 0]
    return least


@strict_kernel
def on_simplex(norms_of: Floats, cosines_of: Floats, present: Flags, c: float) -> Solved:
    """CAGrad: g_0 + v, v the best of length c |g_0|; of two that are opposite v = -c g_0."""
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    trust = np.ones(blocks)
    r, lengths, y = np.empty((views, 2)), np.empty((views, 2)), np.empty((views, 2))
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        count = _reciprocals(norms, present[block], r)
        unit = multiply((largest(norms), 0.0), (float(max(count, 1)), 0.0))
        for k in range(views):
            lengths[k, 0], lengths[k, 1] = divide(at(norms, k), unit)
            y[k, 0], y[k, 1] = 0.0, 0.0
        if 1.0 + _pair_cosine(cosines) <= OPPOSITE:
            for k in range(views):
                y[k, 0], y[k, 1] = multiply((-min(c, 1.0), 0.0), at(lengths, k))
        elif count > 1:
            trust[block] = _conflict_averse(cosines, lengths, r, present[block], c, y)
        for k in range(views):
            if present[block, k]:
                total = add(at(lengths, k), at(y, k))
                length = divide(unit, multiply(at(norms, k), (float(views), 0.0)))
                weights[block, k, 0], weights[block, k, 1] = multiply(total, length)
    return weights, trust
