"""Kernels for minima over convex combinations of the gradients (MGDA, CAGrad).

Weights w with w >= 0 and sum w = 1 are stored as x_k = w_k |g_k| / s, where s is the smallest norm.
In this form, the combination is sum x_k e_k for unit gradients e_k. In this form, the combination
depends only on the cosines, for any ratio of norms. The constraint is sum_k r_k x_k = 1 with r_k =
s / |g_k|. Up to a factor, MGDA and CAGrad both need the nearest point in a polyhedron {x: x.e_k >=
level r_k}:

- MGDA: for any level, the point nearest to 0 has the direction of the shortest combination.
- CAGrad: let d be the direction that maximizes min_k g_k.d in the ball with radius rho around g_0.
  Then d is the point nearest to g_0, at the level for which this point has the distance rho from
  g_0.
"""

from typing import NamedTuple

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part, strict_section
from crossgrad_operators.numba_kernels.digits import (
    Exact,
    Pair,
    Pairs,
    at,
    clear,
    copy,
    longest_of,
    minus,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)
from crossgrad_operators.numba_kernels.directions import (
    Flags,
    Floats,
    Solved,
    directions,
    what_is_left,
)
from crossgrad_operators.numba_kernels.normal import OPPOSITE
from crossgrad_operators.numba_kernels.polyhedron import (
    ROUNDS,
    Polyhedron,
    approach,
    forget,
    is_settled,
    polyhedron,
    project,
    share_left,
    square,
    substitute,
)

#: Maximum number of levels that the search tries. About five levels are usually enough.
LEVELS = 60
#: The search ends when the active constraints no longer change and the change of the level is small
#: or changes its sign. A change is small if its magnitude is at most this share of the level. Later
#: rounds correct the remaining error.
CLOSE = 1e-6
#: If the ridge adds more than this share of rho^2 to the squared distance, the directions may
#: cancel each other.
HELD_BY_RIDGE = 1e-5
#: Two squared distances count as equal if their relative difference is at most this value.
TIE = 1e-9
#: Two gradients are combined only if the squared sine of their angle is at least this value.
PIVOT = 1e-15


@strict_device
def _reciprocals(norms: Pairs, present: Flags, r: Pairs, exact: Exact) -> None:
    """Write r_k = s / |g_k| to `r`, where s is the smallest norm.

    Views without a gradient get zeros.
    """
    shortest = -1
    for k in range(present.size):
        if present[k] and (shortest < 0 or norms[k, 0] < norms[shortest, 0]):
            shortest = k
    clear(r)
    for k in range(present.size):
        if present[k]:
            put(r, k, quotient(at(norms, shortest), at(norms, k), exact))


@strict_device
def _mgda_pair(cosine: float, r: Pairs, x: Pairs) -> None:
    """Write x [2] for the shortest vector among two gradients and their convex combinations."""
    one, other = r[0, 0], r[1, 0]
    x[0, 0], x[1, 0] = 1.0 / one, 0.0
    best = x[0, 0] * x[0, 0]
    if (1.0 / other) * (1.0 / other) < best:
        x[0, 0], x[1, 0] = 0.0, 1.0 / other
        best = x[1, 0] * x[1, 0]
    pivot = np.sqrt(max(1.0 - cosine * cosine, PIVOT))
    second = (other - cosine * one) / pivot / pivot
    first = one - cosine * second
    level = one * first + other * second
    if level > 0.0:
        first, second = first / level, second / level
        if first >= 0.0 and second >= 0.0:
            length = first * (first + cosine * second) + second * (cosine * first + second)
            if max(length, 0.0) < best:
                x[0, 0], x[1, 0] = first, second


@strict_section
def _shortest(problem: Polyhedron, x: Pairs) -> float:
    """Compute x for the shortest combination.

    Return the share of x that is not rounding noise. The array `problem.heights` must contain the
    quotients r_k = s / |g_k|.
    """
    exact, r = problem.rounding.exact, problem.heights
    if len(x) == 2 and exact is None and r[0, 0] > 0.0 and r[1, 0] > 0.0:
        _mgda_pair(problem.cosines[0, 1, 0], r, x)
    else:
        project(problem)
        total = products(problem.y, r, 0, len(x), exact)
        for k in range(len(x)):
            put(x, k, quotient(at(problem.y, k), total, exact))
    return what_is_left(problem, x)


@strict_kernel
def mgda(gramians: Floats, rounding_residuals: Floats, present: Flags, exact: Exact) -> Solved:
    """Return the weights [B, K] of the shortest convex combination.

    Return zeros if its length is only rounding noise.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    problem = polyhedron(views, exact)
    norms, x = np.zeros((views, 2)), np.zeros((views, 2))
    for b in range(blocks):
        count = directions(
            gramians[b], rounding_residuals[b], present[b], norms, problem.cosines, exact
        )
        if count == 0:
            continue
        _reciprocals(norms, present[b], problem.heights, exact)
        problem.ill_conditioned[0] = False
        share = _shortest(problem, x)
        for k in range(views):
            result[b, k] = product(at(x, k), at(problem.heights, k), exact)[0] * share
        ill_conditioned[b] = problem.ill_conditioned[0]
    return result, ill_conditioned


class Search(NamedTuple):
    """CAGrad's search for the level at which the point nearest to g_0 has the distance rho.

    Attributes:
        q: [K] products e_k.g_0 with the unit gradients e_k.
        r: [K] quotients s / |g_k|, with s the smallest norm.
        rho: The squared distance, and the distance.
    """

    q: Pairs
    r: Pairs
    rho: tuple[Pair, Pair]


@strict_device
def _limits(search: Search) -> tuple[float, float]:
    """Return a lower and an upper limit of the level.

    Below the lower limit, no constraint is active. At the upper limit, one constraint alone already
    has the distance rho.
    """
    low, high = np.inf, np.inf
    for k in range(len(search.r)):
        q, r = search.q[k, 0], search.r[k, 0]
        if r > 0.0:
            low, high = min(low, q / r), min(high, (q + search.rho[1][0]) / r)
    return low, high


@strict_device
def _change(problem: Polyhedron, count: int, search: Search, level: Pair, ridge: float) -> Pair:
    """Return the change of the level after which the nearest point has the distance rho.

    The active constraints are assumed not to change.

    With the derivative a = C^-1 r of the multipliers, the squared distance is a quadratic function
    of this change. The change is infinite if no constraint is active. The change is also infinite
    if the rounding errors of very large multipliers exceed the distance.
    """
    exact, slope = problem.rounding.exact, problem.step
    substitute(problem, count, search.r, slope)
    gap, along, across = search.rho[0], (0.0, 0.0), (0.0, 0.0)
    for i in range(count):
        k = problem.chosen[i]
        y, a, r = at(problem.y, k), at(slope, k), at(search.r, k)
        # For active constraints, C y + q - level r + ridge (y - centre) = 0. The equation gives C
        # y, and its derivative gives C a.
        pull = minus((ridge * y[0], ridge * y[1]), (ridge * problem.centre[k, 0], 0.0), exact)
        force = minus(product(level, r, exact), plus(at(search.q, k), pull, exact), exact)
        turn = minus(r, (ridge * a[0], ridge * a[1]), exact)
        gap = minus(gap, product(y, force, exact), exact)
        along = plus(along, product(y, turn, exact), exact)
        across = plus(across, product(a, turn, exact), exact)
    if not along[0] > 0.0:
        return (-np.inf, 0.0) if count > 0 else (np.inf, 0.0)
    under = plus(product(along, along, exact), product(across, gap, exact), exact)
    return quotient(gap, plus(along, root(under, exact), exact), exact)


@strict_device
def _is_beyond_reach(problem: Polyhedron, search: Search) -> bool:
    """Return True if only the ridge keeps the multipliers bounded.

    If only the ridge bounds the multipliers, the weighted sum of the directions is rounding noise.
    """
    total = 0.0
    for k in range(len(search.r)):
        moved = problem.y[k, 0] - problem.centre[k, 0]
        total += moved * moved
    return problem.rounding.ridge * total > 2.0 * search.rho[0][0]


@strict_device
def _repeats(problem: Polyhedron, before: Flags) -> bool:
    """Return True if the active constraints equal the stored constraints.

    After the comparison, store the active constraints.
    """
    same = True
    for k in range(before.size):
        same &= before[k] == problem.active[k]
        before[k] = problem.active[k]
    return same


@strict_section
def _find_level(problem: Polyhedron, search: Search, level: Pair, ridge: float) -> Pair:
    """Return the level at which the nearest point has the distance rho.

    The multipliers of this point are computed, too.

    The distance is a convex and increasing function of the level. The function consists of pieces
    with different active constraints, which are solved one after another. If a solution is outside
    the interval that contains the level, the interval is halved instead.
    """
    exact, before = problem.rounding.exact, np.zeros(problem.active.size, np.bool_)
    low, high = _limits(search)
    high += 1e-9 * (high - low)
    solved, last = False, 0.0
    for _ in range(LEVELS):
        for k in range(len(search.r)):
            put(problem.heights, k, product(level, at(search.r, k), exact))
        count = approach(problem)
        same = _repeats(problem, before) and solved
        change = _change(problem, count, search, level, ridge)
        if _is_beyond_reach(problem, search):
            change = (-np.inf, 0.0)
        if change[0] <= 0.0:
            high = level[0]
        else:
            low = level[0]
        if same and (abs(change[0]) <= CLOSE * abs(level[0]) or change[0] * last < 0.0):
            break
        last = change[0] if same else 0.0
        solved = low <= level[0] + change[0] <= high
        level = plus(level, change, exact) if solved else (0.5 * (low + high), 0.0)
    return level


@strict_section
def _reach(problem: Polyhedron, search: Search) -> None:
    """Increase the level of all constraints until the nearest point has the distance rho."""
    forget(problem)
    level = (_limits(search)[1], 0.0)
    for turn in range(ROUNDS):
        copy(problem.y, problem.centre)
        # In the first round, the ridge counts as a part of the directions, so that the directions
        # cannot cancel.
        ridge = problem.rounding.ridge if turn > 0 else 0.0
        level = _find_level(problem, search, level, ridge)
        if is_settled(problem) or share_left(problem, problem.y) == 0.0:
            return


@strict_section
def _defined(problem: Polyhedron, search: Search) -> float:
    """Return the share of CAGrad's direction that is well defined. The multipliers are not changed.

    The direction is undefined if 0 is a convex combination of the gradients and the point of level
    0 is within the distance rho. If the direction is undefined, no level above 0 can be reached,
    and many directions are equally good.
    """
    largest, rho = 0.0, search.rho[0][0]
    for k in range(len(search.r)):
        largest = max(largest, problem.y[k, 0])
    if problem.rounding.ridge * largest * largest <= HELD_BY_RIDGE * rho:
        return 1.0
    base, y = problem.base.copy(), problem.y.copy()
    clear(problem.base)
    copy(search.r, problem.heights)
    project(problem)
    share = share_left(problem, problem.y)
    copy(base, problem.base)
    if share < 1.0:
        clear(problem.heights)
        project(problem)
        if square(problem, problem.y)[0] >= (1.0 - TIE) * rho:
            share = 1.0
    copy(y, problem.y)
    return share


@strict_device
def _cagrad_pair(n1: float, n2: float, cosine: float, c: float) -> tuple[float, float, float]:
    """Return three numbers for two gradients with norms 1 = n1 >= n2.

    The three numbers are the weight of g_1 in g_w, |g_w|, and |g_0|. Here g_0 is the mean gradient.

    The objective (a - b) x / 2 + c |g_0| sqrt(D (x - x_0)^2 + h^2) is convex in the weight x of
    g_1. The numbers a, b, D, x_0 and h do not depend on x. Sums of squares are arranged such that
    only the cosine itself can cause cancellation. The weight of the longer gradient is returned,
    because this weight may be very small.
    """
    product = n1 * n2
    gap = (n1 - n2) * (n1 - n2)
    between = gap + 2.0 * product * (1.0 - cosine)
    mean = 0.5 * np.sqrt(gap + 2.0 * product * (1.0 + cosine))
    if between <= 0.0:
        return 0.5, mean, mean
    x0 = n2 * (n2 - cosine * n1) / between
    slope = (n1 - n2) * (n1 + n2)
    steep = 2.0 * c * mean * np.sqrt(between)
    x = 0.0
    if slope < steep:
        h = product * np.sqrt((1.0 - cosine) * (1.0 + cosine) / between)
        ratio = slope / steep
        x = x0 - h * ratio / np.sqrt((1.0 - ratio) * (1.0 + ratio)) / np.sqrt(between)
        x = min(max(x, 0.0), 1.0)
    one, other = x * n1, (1.0 - x) * n2
    length = np.sqrt((one - other) * (one - other) + 2.0 * one * other * (1.0 + cosine))
    return x, length, mean


@strict_part
def _cagrad_two(norms: Pairs, cosine: float, c: float, result: Floats) -> None:
    """Write the weights [2] of two gradients to `result`."""
    i, j = (0, 1) if norms[0, 0] >= norms[1, 0] else (1, 0)
    longest = norms[i, 0]
    share, length, mean = _cagrad_pair(1.0, norms[j, 0] / longest, cosine, c)
    if length > 0.0:
        factor = c * mean / length
        result[i] = 0.5 + factor * share
        result[j] = 0.5 + factor * (1.0 - share)


@strict_device
def _set_out(problem: Polyhedron, norms: Pairs, q: Pairs, c: float) -> Search:
    """Return the search that starts at the mean, in units of the longest gradient.

    The array `problem.heights` must contain the quotients r_k = s / |g_k|.
    """
    exact, views = problem.rounding.exact, len(norms)
    longest, count = longest_of(norms)
    r = np.empty((views, 2))
    copy(problem.heights, r)
    for k in range(views):
        relative_norm = quotient(at(norms, k), longest, exact)
        put(problem.base, k, quotient(relative_norm, (count, 0.0), exact))
    for k in range(views):
        put(q, k, products(problem.cosines[k], problem.base, 0, views, exact))
    mean = square(problem, problem.base)
    rho = product((c, 0.0), root(mean, exact), exact)
    return Search(q, r, (product(rho, rho, exact), rho))


@strict_section
def _cagrad_many(problem: Polyhedron, norms: Pairs, q: Pairs, c: float, result: Floats) -> None:
    """Write the weights [K] of two or more gradients to `result`. The array q is working memory.

    If the mean or some convex combination of the gradients is zero, the direction is undefined. If
    the direction is undefined, the result is zero.
    """
    exact, views = problem.rounding.exact, len(norms)
    search = _set_out(problem, norms, q, c)
    share = share_left(problem, problem.base)
    if share > 0.0:
        _reach(problem, search)
        share *= share_left(problem, problem.y) * _defined(problem, search)
    if share == 0.0:
        return
    longest, count = longest_of(norms)
    factor = quotient(search.rho[1], root(square(problem, problem.y), exact), exact)
    for k in range(views):
        if norms[k, 0] > 0.0:
            added = product(factor, at(problem.y, k), exact)
            total = plus(at(problem.base, k), added, exact)
            weight = product(total, quotient(longest, at(norms, k), exact), exact)
            result[k] = share * weight[0] * count / views


@strict_device
def _least_cosine(problem: Polyhedron) -> float:
    """Return the smallest cosine between two views that have a gradient."""
    least, cosines = 1.0, problem.cosines
    for i in range(len(cosines)):
        for j in range(i):
            if cosines[i, i, 0] > 0.0 and cosines[j, j, 0] > 0.0:
                least = min(least, cosines[i, j, 0])
    return least


@strict_section
def _cagrad(problem: Polyhedron, norms: Pairs, q: Pairs, c: float, result: Floats) -> None:
    """Write the weights [K] of one block to `result`.

    The array `problem.heights` must contain the quotients r_k = s / |g_k|.
    """
    views, exact = len(norms), problem.rounding.exact
    _, count = longest_of(norms)
    cosine = _least_cosine(problem)
    opposite = count == 2 and 1.0 + cosine <= OPPOSITE
    if count <= 1 or c == 0.0 or opposite:
        share = max(1.0 - c, 0.0) if opposite else 1.0
        for k in range(views):
            result[k] = share / views if norms[k, 0] > 0.0 else 0.0
    elif views == 2 and exact is None:
        _cagrad_two(norms, cosine, c, result)
    else:
        _cagrad_many(problem, norms, q, c, result)


@strict_kernel
def cagrad(
    gramians: Floats, rounding_residuals: Floats, present: Flags, exact: Exact, c: float
) -> Solved:
    """Return weights [B, K] of CAGrad's direction, 1/K + c |g_0| w_k / |g_w|, without rescaling."""
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    problem = polyhedron(views, exact)
    norms, q = np.zeros((views, 2)), np.zeros((views, 2))
    for b in range(blocks):
        count = directions(
            gramians[b], rounding_residuals[b], present[b], norms, problem.cosines, exact
        )
        if count > 0:
            problem.ill_conditioned[0] = False
            _reciprocals(norms, present[b], problem.heights, exact)
            _cagrad(problem, norms, q, c, result[b])
            ill_conditioned[b] = problem.ill_conditioned[0]
    return result, ill_conditioned
