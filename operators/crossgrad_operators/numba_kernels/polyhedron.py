"""Find the point of a polyhedron {x: x.e_k >= h_k} nearest to a given point.

Only the cosines of the e_k are needed.

For the given point sum b_k e_k, the nearest point is sum (b_k + y_k) e_k with y >= 0. A multiplier
y_k is positive only if x.e_k = h_k. MGDA, CAGrad, UPGrad and DualProj all need a nearest point of a
polyhedron. If the e_k are linearly dependent, the nearest point is unique, but the multipliers are
not.

The cosines contain rounding errors, so the smallest eigenvalues of the cosine matrix are unknown. A
small number (the ridge) is therefore added to the diagonal, so that the matrix becomes positive
definite. The ridge keeps the multipliers bounded, and makes the multipliers continuous functions of
the cosines. If the ridge affects the result visibly, the solution is repeated, starting from the
previous solution (proximal point iteration). After these rounds, the component along an eigenvector
with eigenvalue l is too small only by the share (ridge / (l + ridge))^ROUNDS. If the directions are
not nearly dependent, one round is enough.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import strict_device, strict_part
from crossgrad_operators.numba_kernels.digits import (
    Exact,
    Pair,
    Pairs,
    at,
    clear,
    copy,
    minus,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)

Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

#: Maximum number of rounds of the proximal point iteration. Each round starts from the solution of
#: the previous round.
ROUNDS = 3
#: If a pivot (the square of a sine) is at most this value, a result with 16 digits may be
#: inaccurate.
ILL_CONDITIONED = 1e-6
#: Maximum number of changes of the active set, for each view and round. Observed problems needed at
#: most one sixth of this number.
CHANGES = 12


class Rounding(NamedTuple):
    """Limits that depend on the number of digits of the cosines.

    Attributes:
        exact: True for 32 digits, None for 16 digits.
        ridge: Number that is added to the diagonal of the cosine matrix. The ridge exceeds the
            rounding error of a zero eigenvalue, also for long sums. The ridge is still too small to
            affect gradients that have half as many digits.
        slack: A constraint counts as violated if the violation exceeds this share of its terms.
        shown: The effect of the ridge is corrected if the ridge exceeds this share of a pivot.
        noise: Rounding error of |sum x_k e_k|^2, relative to sum x_k^2. Opposite gradients with
            half as many digits can differ by this amount.
    """

    exact: Exact
    ridge: float
    slack: float
    shown: float
    noise: float


class Polyhedron(NamedTuple):
    """A problem, its present solution, and working memory.

    Each number is a pair of a high and a low part.

    Attributes:
        cosines: [K, K] cosines C. Rows and columns of views without a gradient are zero.
        base: [K] coefficients b of the given point.
        heights: [K] right-hand sides h of the constraints.
        y: [K] multipliers y.
        centre: [K] multipliers of the previous round, towards which the ridge pulls.
        active: [K] True if a constraint is active, so that its multiplier may be positive.
        barred: [K] True if a constraint must stay inactive because of rounding.
        chosen: [K] indices of the active constraints, at the start of the array.
        point: [K] coefficients b + y of the present point.
        gradient: [K] gradient C (b + y) - h + ridge (y - centre). If y = centre, the gradient is
            the slack of the constraints.
        factor: [K, K] Cholesky factor L of the active cosines with the ridge. The part above the
            diagonal contains L^T.
        step: [K] change of the multipliers.
        room: [K] working memory of `substitute`.
        ill_conditioned: [1] True if directions are nearly dependent, so that 16 digits may not be
            enough.
        rounding: Limits that depend on the number of digits.
    """

    cosines: Pairs
    base: Pairs
    heights: Pairs
    y: Pairs
    centre: Pairs
    active: Flags
    barred: Flags
    chosen: Indices
    point: Pairs
    gradient: Pairs
    factor: Pairs
    step: Pairs
    room: Pairs
    ill_conditioned: Flags
    rounding: Rounding


@strict_part
def polyhedron(views: int, exact: Exact) -> Polyhedron:
    """Return working memory for problems of K views."""
    if exact is None:
        rounding = Rounding(exact, 1e-13, 1e-15, 1e-10, 1e-14)
    else:
        rounding = Rounding(exact, 1e-30, 1e-31, 1e-19, 1e-26)
    return Polyhedron(
        np.zeros((views, views, 2)),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.zeros(views, np.bool_),
        np.zeros(views, np.bool_),
        np.zeros(views, np.int64),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.zeros((views, views, 2)),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.zeros(1, np.bool_),
        rounding,
    )


@strict_part
def _slope(problem: Polyhedron) -> float:
    """Compute the gradient, and return the largest coefficient of the present point."""
    views, exact, ridge = problem.active.size, problem.rounding.exact, problem.rounding.ridge
    size = 0.0
    for k in range(views):
        put(problem.point, k, plus(at(problem.base, k), at(problem.y, k), exact))
        size = max(size, problem.point[k, 0])
    for k in range(views):
        slack = products(problem.cosines[k], problem.point, 0, views, exact)
        slack = minus(slack, at(problem.heights, k), exact)
        pull = ridge * (problem.y[k, 0] - problem.centre[k, 0])
        put(problem.gradient, k, plus(slack, (pull, 0.0), exact))
    return size


@strict_part
def _factorise(problem: Polyhedron) -> int:
    """List the active constraints, factorize their matrix, and return their number."""
    exact, ridge = problem.rounding.exact, problem.rounding.ridge
    factor, chosen = problem.factor, problem.chosen
    count = 0
    for k in range(problem.active.size):
        if problem.active[k]:
            chosen[count] = k
            count += 1
    for i in range(count):
        for j in range(i):
            left = products(factor[i], factor[j], 0, j, exact)
            left = minus(at(problem.cosines[chosen[i]], chosen[j]), left, exact)
            put(factor[i], j, quotient(left, at(factor[j], j), exact))
            factor[j, i, 0], factor[j, i, 1] = factor[i, j, 0], factor[i, j, 1]
        pivot = plus(at(problem.cosines[chosen[i]], chosen[i]), (ridge, 0.0), exact)
        pivot = minus(pivot, products(factor[i], factor[i], 0, i, exact), exact)
        put(factor[i], i, root(pivot if pivot[0] > 0.1 * ridge else (0.1 * ridge, 0.0), exact))
    return count


@strict_part
def substitute(problem: Polyhedron, count: int, right: Pairs, out: Pairs) -> None:
    """Solve L L^T x = r for the active constraints.

    The arrays r (`right`) and x (`out`) are indexed by view.
    """
    factor, chosen, room = problem.factor, problem.chosen, problem.room
    exact = problem.rounding.exact
    for i in range(count):
        left = minus(at(right, chosen[i]), products(factor[i], room, 0, i, exact), exact)
        put(room, i, quotient(left, at(factor[i], i), exact))
    for i in range(count - 1, -1, -1):
        left = minus(at(room, i), products(factor[i], room, i + 1, count, exact), exact)
        put(room, i, quotient(left, at(factor[i], i), exact))
        put(out, chosen[i], at(room, i))


@strict_device
def _first_zero(problem: Polyhedron, count: int) -> tuple[float, int]:
    """Return the share of the step after which a multiplier becomes zero.

    The second result is the number of the constraint to which this multiplier belongs. If no
    multiplier becomes zero, return (1, -1).
    """
    share, leaving = 1.0, -1
    for i in range(count):
        k = problem.chosen[i]
        y, step = problem.y[k, 0], problem.step[k, 0]
        if y - step <= 0.0:
            candidate = y / step if step > 0.0 else 0.0
            if leaving < 0 or candidate < share:
                share, leaving = candidate, k
    return share, leaving


@strict_part
def _settle(problem: Polyhedron, entered: int) -> int:
    """Minimize over the active constraints, and remove constraints whose multipliers become zero.

    Returns:
        The number of active constraints in the last factorization.
    """
    exact = problem.rounding.exact
    while True:
        count = _factorise(problem)
        if count == 0:
            return 0
        substitute(problem, count, problem.gradient, problem.step)
        share, leaving = _first_zero(problem, count)
        for i in range(count):
            k = problem.chosen[i]
            change = product((share, 0.0), at(problem.step, k), exact)
            after = minus(at(problem.y, k), change, exact)
            put(problem.y, k, after if after[0] > 0.0 else (0.0, 0.0))
        if leaving < 0:
            return count
        put(problem.y, leaving, (0.0, 0.0))
        problem.active[leaving] = False
        if leaving == entered:
            problem.barred[leaving] = True
        _slope(problem)


@strict_device
def _unbar(problem: Polyhedron) -> None:
    for k in range(problem.barred.size):
        problem.barred[k] = False


@strict_device
def forget(problem: Polyhedron) -> None:
    """Reset all multipliers to zero and all constraints to inactive."""
    clear(problem.y)
    for k in range(problem.active.size):
        problem.active[k] = False


@strict_part
def approach(problem: Polyhedron) -> int:
    """Find the multipliers of the nearest point while the ridge pulls towards `centre`.

    The function uses the active-set method of Lawson and Hanson.

    Returns:
        The number of active constraints. `substitute` can use the factorization of the active
        constraints.
    """
    views, share = problem.active.size, problem.rounding.slack
    _unbar(problem)
    _slope(problem)
    entering = -1
    count = _settle(problem, entering)
    for _ in range(CHANGES * views):
        size = _slope(problem)
        worst, entering = 0.0, -1
        for k in range(views):
            slack = problem.gradient[k, 0] + share * (size + abs(problem.heights[k, 0]))
            if slack < worst and not (problem.active[k] or problem.barred[k]):
                worst, entering = slack, k
        if entering < 0:
            break
        problem.active[entering] = True
        count = _settle(problem, entering)
        if not problem.barred[entering]:
            _unbar(problem)
    return count


@strict_device
def is_settled(problem: Polyhedron) -> bool:
    """Return True if the ridge has no visible effect.

    The ridge has no visible effect if the active directions are not nearly dependent.

    The function also sets `ill_conditioned` if the directions require more digits.
    """
    least, count = 1.0, 0
    for k in range(problem.active.size):
        if problem.barred[k]:
            least = 0.0
        count += int(problem.active[k])
    for i in range(count):
        least = min(least, problem.factor[i, i, 0])
    problem.ill_conditioned[0] |= least * least <= ILL_CONDITIONED
    return problem.rounding.ridge <= problem.rounding.shown * least * least


@strict_part
def project(problem: Polyhedron) -> None:
    """Compute the multipliers of the nearest point."""
    forget(problem)
    for _ in range(ROUNDS):
        copy(problem.y, problem.centre)
        approach(problem)
        if is_settled(problem):
            return


@strict_part
def square(problem: Polyhedron, x: Pairs) -> Pair:
    """Return the squared length |sum x_k e_k|^2."""
    views, exact = problem.active.size, problem.rounding.exact
    total = (0.0, 0.0)
    for k in range(views):
        along = products(problem.cosines[k], x, 0, views, exact)
        total = plus(total, product(along, at(x, k), exact), exact)
    return total


@strict_part
def share_left(problem: Polyhedron, x: Pairs) -> float:
    """Return a factor for coefficients x.

    The factor is 0 if the sum of the directions, weighted by x, is only rounding noise.

    Above the noise, the factor increases continuously. The factor reaches 1 when the squared length
    is twice the noise.
    """
    noise = problem.rounding.noise * products(x, x, 0, problem.active.size, None)[0]
    if noise == 0.0:
        return 0.0
    return min(max(square(problem, x)[0] / noise - 1.0, 0.0), 1.0)
