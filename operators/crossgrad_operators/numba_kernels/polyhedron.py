"""The point of a polyhedron {x: x.e_k >= h_k} that is nearest to a given one, from cosines alone.

The nearest point to sum b_k e_k is sum (b_k + y_k) e_k with y >= 0, where a multiplier y_k is
positive only if x.e_k = h_k. MGDA, CAGrad, UPGrad and DualProj all ask for such points. Where the
e_k depend on each other the multipliers are not unique and the point is.

The matrix of cosines is known up to rounding, which says nothing about its smallest eigenvalues. It
is therefore made definite by a ridge on its diagonal, which bounds the multipliers and lets them
depend continuously on the cosines, and the ridge's effect is taken back where it matters by
repeating the step from its own result (proximal point iteration): of a component along an
eigenvector of eigenvalue l only (ridge / (l + ridge))^ROUNDS is missing in the end. Directions that
are far from dependent need no second round.
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

#: Steps from the last result.
ROUNDS = 3
#: Smallest pivot, the square of a sine, up to which 16 digits may err.
ILL_CONDITIONED = 1e-6
#: Changes of the set of active constraints per view and round; a sixth of it has been seen.
CHANGES = 12


class Rounding(NamedTuple):
    """Bounds that follow from the digits that the cosines have.

    Attributes:
        exact: True for 32 digits, None for 16.
        ridge: Added to the cosines' diagonal: above what rounding makes of a zero eigenvalue (ten
            times K units, for long sums), below what shows in gradients of half the digits.
        slack: A constraint counts as violated beyond this share of the terms that it is the sum of.
        shown: What the ridge may be of a pivot before it has to be taken back.
        noise: What rounding leaves undetermined in |sum x_k e_k|^2, as a share of sum x_k^2; also
            what gradients of half the digits differ by that were meant to be opposite.
    """

    exact: Exact
    ridge: float
    slack: float
    shown: float
    noise: float


class Polyhedron(NamedTuple):
    """One problem, its solution so far, and room to work in; numbers are pairs.

    Attributes:
        cosines: [K, K]; zero in rows and columns of views that have no gradient.
        base: [K] b.
        heights: [K] h.
        y: [K] multipliers.
        centre: [K] multipliers that the ridge pulls to.
        active: [K] whether a multiplier is free to be positive.
        barred: [K] whether rounding has kept a constraint from becoming active.
        chosen: [K] the active constraints, at the front.
        point: [K] b + y.
        gradient: [K] C (b + y) - h + ridge (y - centre), the slack where y = centre.
        factor: [K, K] L of the active cosines with their ridge, L L^T; L^T above the diagonal.
        step: [K] change of the multipliers.
        room: [K] of whatever is being solved for.
        ill_conditioned: [1] whether directions nearly depend on each other: 16 digits may err.
        rounding: The digits of it all.
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
    """Room for problems of K views."""
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
    """Fills the gradient; returns the largest coefficient of the terms that it adds up."""
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
    """Lists the active constraints, factorises their matrix, and returns their number."""
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
    """Solves L L^T x = r for the active constraints; r and x have their places among all."""
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
    """The share of the step at which a multiplier meets zero, and which; 1 and -1 if none does."""
    share, leaving = 1.0, -1
    for i in range(count):
        k = problem.chosen[i]
        y, step = problem.y[k, 0], problem.step[k, 0]
        if y - step <= 0.0:
            part = y / step if step > 0.0 else 0.0
            if leaving < 0 or part < share:
                share, leaving = part, k
    return share, leaving


@strict_part
def _settle(problem: Polyhedron, entered: int) -> int:
    """Goes to the minimum of the active face, dropping constraints whose multiplier meets zero.

    Returns:
        The number of active constraints of the last factor.
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
    """Forgets the multipliers."""
    clear(problem.y)
    for k in range(problem.active.size):
        problem.active[k] = False


@strict_part
def approach(problem: Polyhedron) -> int:
    """Multipliers of the nearest point while the ridge pulls to `centre`, from the present ones.

    Lawson and Hanson's algorithm.

    Returns:
        The number of active constraints, whose factor is that of `substitute`.
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
    """Whether the ridge does not show: all active directions are far from dependent.

    Notes whether they are so near that more digits are due.
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
    """Multipliers of the nearest point."""
    forget(problem)
    for _ in range(ROUNDS):
        copy(problem.y, problem.centre)
        approach(problem)
        if is_settled(problem):
            return


@strict_part
def square(problem: Polyhedron, x: Pairs) -> Pair:
    """|sum x_k e_k|^2."""
    views, exact = problem.active.size, problem.rounding.exact
    total = (0.0, 0.0)
    for k in range(views):
        along = products(problem.cosines[k], x, 0, views, exact)
        total = plus(total, product(along, at(x, k), exact), exact)
    return total


@strict_part
def share_left(problem: Polyhedron, x: Pairs) -> float:
    """Factor for coefficients x: 0 where nothing but rounding noise is left of their sum.

    From there on the share grows continuously, to 1 at twice the square.
    """
    noise = problem.rounding.noise * products(x, x, 0, problem.active.size, None)[0]
    if noise == 0.0:
        return 0.0
    return min(max(square(problem, x)[0] / noise - 1.0, 0.0), 1.0)
