"""Oracles with 50 digits for operators that solve small optimization problems.

The operators use active sets in float64, and add a ridge to the cosine matrix. The oracles use
active sets without a ridge. Every result is checked against the optimality conditions. Only the
minimum meets these conditions. If gradients are linearly dependent, the weights are not unique. For
linearly dependent gradients, the oracles return weights of independent gradients.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from crossgrad_operators.stress.exact import (
    Matrix,
    Number,
    Vector,
    apply,
    complementary,
    dot,
    form,
    number,
    require_mpmath,
    solve,
)
from crossgrad_operators.stress.oracles import (
    OPPOSITE,
    Question,
    cancels,
    column_sums,
    cosines,
    is_noise,
    lengths,
    zeros,
)

#: Number of digits for matrices whose eigenvalues differ by a factor of up to 1e60.
WIDE: Final = 150
#: The first iteration runs in float64. The iteration ends at the Newton decrement `ROUGH`, or when
#: an element of beta reaches `LONG`.
ROUGH: Final = 1e-3
LONG: Final = 1e7
#: If the smallest eigenvalue divided by the largest is above this value, float64 is accurate enough
#: to determine the rank.
FAR: Final = 1e-10
#: A sum counts as zero if |sum x_k e_k|^2, divided by the largest x_k^2, is at most this value.
VANISHED = "1e-45"
#: Largest number of levels that the search of CAGrad tries.
LEVELS = 400


class UnprovenError(RuntimeError):
    """The oracle found no point that meets the optimality conditions.

    The result of the oracle is not proven.
    """


def imtl_g(question: Question) -> Vector:
    """Return weights with sum 1 and equal projections.

    For a singular Gramian, the pseudo-inverse is used.
    """
    gramian, count = question.gramian, question.count
    n, cosine = lengths(gramian), cosines(gramian)
    if count == 1:
        return [number(1)]
    if count == 2:  # noqa: PLR2004
        total = n[0] + n[1]
        opposite = 1 + cosine[0][1] <= number(OPPOSITE)
        return zeros(2) if opposite else [n[1] / total, n[0] / total]
    v = _equal_projections(gramian, n, cosine)
    total, largest = sum(v), max(abs(x) for x in v)
    # The sum of all elements of v is a denominator. The rule for cancelling sums decides whether
    # this sum counts as zero.
    if cancels(total**2, largest) or is_noise(cosine, [x * y for x, y in zip(v, n, strict=True)]):
        return zeros(count)
    return [x / total for x in v]


def _equal_projections(gramian: Matrix, n: Vector, cosine: Matrix) -> Vector:
    rank, count = _rank(cosine), len(n)
    if rank == count:
        v = solve(cosine, range(count), [number(1)] * count)
        if v is not None:
            return [x / y for x, y in zip(v, n, strict=True)]
    # Use more digits, because the largest eigenvalue may be 1e60 times the smallest eigenvalue.
    with require_mpmath().mp.workdps(WIDE):
        return _shortest_solution(gramian, n, rank)


def _rank(cosine: Matrix) -> int:
    """Return the number of eigenvalues above 1e-12 times the largest eigenvalue."""
    mp = require_mpmath().mp
    rough = np.linalg.eigvalsh(np.array(cosine, dtype=np.float64))
    # Eigenvalues in float64 have errors of about 1e-14. An error of 1e-14 does not matter if all
    # eigenvalues are far above the limit.
    if rough.min() > FAR * rough.max():
        return len(cosine)
    values, _ = mp.eigsy(mp.matrix(cosine))
    return sum(1 for v in values if v > number(OPPOSITE) * max(values))


def _shortest_solution(gramian: Matrix, n: Vector, rank: int) -> Vector:
    mp, count = require_mpmath().mp, len(n)
    values, vectors = mp.eigsy(mp.matrix(gramian))
    largest = sorted(range(count), key=lambda i: values[i])[count - rank :]
    v = zeros(count)
    for i in largest:
        terms = [vectors[k, i] * n[k] for k in range(count)]
        # Skip eigenvectors that are orthogonal to the norms. The terms of these eigenvectors would
        # be rounding noise, divided by an eigenvalue.
        if abs(sum(terms)) > number(OPPOSITE) * sum(abs(t) for t in terms):
            factor = sum(terms) / values[i]
            v = [a + factor * vectors[k, i] for k, a in enumerate(v)]
    return v


def nash(question: Question) -> Vector:
    """Return the Nash-MTL weights, from the solution beta of C beta = 1 / beta with cosines C.

    The weights are multiplied by the geometric mean of the norms.
    """
    mp = require_mpmath().mp
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    count = question.count
    if count == 2:  # noqa: PLR2004
        apart = 1 + cosine[0][1]
        beta = [1 / mp.sqrt(apart)] * 2 if apart > 0 else None
    else:
        beta = _bargain(cosine)
    if beta is None or (count > 1 and cancels(number(count), max(beta))):
        return zeros(count)
    mean = mp.exp(mp.fsum(mp.log(v) for v in n) / count)
    return [b * mean / v for b, v in zip(beta, n, strict=True)]


def _bargain(cosine: Matrix) -> Vector | None:
    """Return the solution beta of the bargaining problem.

    Return None if beta is so large that the result is zero.
    """
    mp = require_mpmath().mp
    count = len(cosine)
    beta = _rough_bargain(cosine)
    for _ in range(2000):
        if _is_hopeless(cosine, beta):
            return None
        slope = [1 - b * v for b, v in zip(beta, apply(cosine, beta), strict=True)]
        hessian = [
            [beta[i] * cosine[i][j] * beta[j] + int(i == j) for j in range(count)]
            for i in range(count)
        ]
        step = solve(hessian, range(count), slope)
        if step is None:
            raise UnprovenError
        decrement = mp.sqrt(abs(dot(slope, step)))
        damping = 1 if decrement < number("0.2") else 1 / (1 + decrement)
        beta = [b * (1 + damping * s) for b, s in zip(beta, step, strict=True)]
        # The last step has squared the remaining error, so that the solution is accurate now.
        if decrement < mp.mpf("1e-25"):
            return beta
    raise UnprovenError


def _rough_bargain(cosine: Matrix) -> Vector:
    """Return a start for Newton's method, computed by damped Newton steps in float64."""
    matrix = np.array(cosine, dtype=np.float64)
    beta = np.ones(len(cosine))
    for _ in range(200):
        hessian = beta[:, None] * matrix * beta + np.eye(len(beta))
        slope = 1 - beta * (matrix @ beta)
        step = np.linalg.solve(hessian, slope)
        decrement = np.sqrt(abs(slope @ step))
        longer = beta * (1 + step / (1 + decrement))
        if not (longer.min() > 0 and longer.max() < LONG) or decrement < ROUGH:
            break
        beta = longer
    return [number(b) for b in beta.tolist()]


def _is_hopeless(cosine: Matrix, beta: Vector) -> bool:
    """Return True if the combination x = beta / sum beta proves that the result is zero.

    Let u be the sum of the bargaining solution, with |u|^2 = K. Then sum x_k / beta_k = sum x_k
    e_k.u is at most |sum x_k e_k| sqrt(K). The inverse of the largest beta is at most as large as
    this bound.
    """
    share = form(cosine, beta) / sum(beta) ** 2
    return bool(len(beta) * share <= 2 * number(OPPOSITE) / len(beta))


def aligned(question: Question) -> Vector:
    """Return the weights of Aligned-MTL, using eigenvalues above n eps l_max."""
    mp = require_mpmath().mp
    count = question.count
    cosine = cosines(question.gramian)
    values, vectors = mp.eigsy(mp.matrix(question.gramian))
    floor = count * mp.mpf(2) ** -52 * max(values)
    if count == 2 and 1 + cosine[0][1] <= number(OPPOSITE):  # noqa: PLR2004
        floor = min(values)
    kept = [i for i in range(count) if values[i] > floor]
    smallest = min(values[i] for i in kept)
    w = zeros(count)
    for i in kept:
        column = [vectors[k, i] for k in range(count)]
        total = mp.fsum(column)
        if abs(total) > number(OPPOSITE):
            factor = mp.sqrt(smallest / values[i]) * total / question.views
            w = [a + factor * b for a, b in zip(w, column, strict=True)]
    return w


def _vanishes(cosine: Matrix, x: Vector) -> bool:
    """Return True if a combination is zero.

    For two directions, the sum of exactly opposite directions also counts as zero.
    """
    largest = max(abs(v) for v in x)
    exactly = form(cosine, x) <= number(VANISHED) * largest**2
    return exactly or (len(x) == 2 and is_noise(cosine, x))  # noqa: PLR2004


def _projection(cosine: Matrix, b: Vector) -> Vector:
    """Return the coefficients of the projection of sum b_k e_k onto the cone {x: x.e_l >= 0}."""
    y = complementary(cosine, apply(cosine, b))
    if y is None:
        raise UnprovenError
    x = [u + v for u, v in zip(b, y, strict=True)]
    return zeros(len(b)) if _vanishes(cosine, x) else x


def upgrad(question: Question) -> Vector:
    """Return the weights of the sum of all projected gradients, divided by K."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    rows = []
    for k in range(question.count):
        x = _projection(cosine, [number(int(i == k)) for i in range(question.count)])
        rows.append([v * n[k] / n[i] / question.views for i, v in enumerate(x)])
    return column_sums(rows)


def dualproj(question: Question) -> Vector:
    """Return the weights of the projected mean gradient."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    longest = max(n)
    x = _projection(cosine, [v / longest for v in n])
    return [v * longest / n[k] / question.views for k, v in enumerate(x)]


def mgda(question: Question) -> Vector:
    """Return the weights of the shortest convex combination."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    r = [min(n) / v for v in n]
    x = shortest(cosine, r)
    return (
        zeros(question.count)
        if _vanishes(cosine, x)
        else [v * w for v, w in zip(x, r, strict=True)]
    )


def shortest(cosine: Matrix, r: Sequence[Number]) -> Vector:
    """Return the coefficients x >= 0 with r.x = 1 for which sum x_k e_k is shortest.

    Up to a factor, these coefficients minimize |sum x_k e_k|^2 + (r.x - 1)^2. The minimization has
    a solution even if 0 is a convex combination of the directions.
    """
    size = range(len(r))
    matrix = [[cosine[i][j] + r[i] * r[j] for j in size] for i in size]
    x = complementary(matrix, [-v for v in r])
    if x is None:
        raise UnprovenError
    total = dot(x, r)
    return [v / total for v in x]


def cagrad(question: Question) -> Vector:
    """Return the weights of g_0 + c |g_0| g_w / |g_w|.

    The oracle searches for the nearest point at a level.
    """
    mp = require_mpmath().mp
    count, c = question.count, number(question.options["c"])
    share = number(count) / question.views
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    if count == 1:
        return [share]
    if count == 2 and 1 + cosine[0][1] <= number(OPPOSITE):  # noqa: PLR2004
        return [max(1 - c, number(0)) * share / 2] * 2
    base = [v / max(n) / count for v in n]
    if form(cosine, base) <= number(VANISHED) * max(base) ** 2:
        return zeros(count)
    added = _as_far_as(cosine, base, [min(n) / v for v in n], c * mp.sqrt(form(cosine, base)))
    if added is None:
        return zeros(count)
    return [share * max(n) / v * (b + y) for v, b, y in zip(n, base, added, strict=True)]


def _as_far_as(cosine: Matrix, base: Vector, r: Vector, rho: Number) -> Vector | None:
    """Return the multipliers of the point nearest to `base` with e_k.d >= level r_k.

    The level is the one for which the distance is rho.

    Return None if 0 is a convex combination and level 0 is reached within this distance. If level 0
    is reached within this distance, no level above 0 can be reached, and the direction is
    undefined.
    """
    q = apply(cosine, base)
    x = shortest(cosine, r)
    low = min(a / b for a, b in zip(q, r, strict=True))
    high = min((a + rho) / b for a, b in zip(q, r, strict=True))
    if form(cosine, x) <= number(VANISHED) * max(x) ** 2:
        y = complementary(cosine, q)
        if y is None:
            raise UnprovenError
        if form(cosine, y) < rho**2 * (1 - number("1e-30")):
            return None
        high = number(0)
    return _found(cosine, (q, r, rho), (low, high))


def _found(
    cosine: Matrix, problem: tuple[Vector, Vector, Number], interval: tuple[Number, Number]
) -> Vector:
    """Return the multipliers for which the distance is rho.

    All levels in the interval must be reachable.
    """
    (q, r, rho), (low, high) = problem, interval
    level = high
    for _ in range(LEVELS):
        y = complementary(cosine, [a - level * b for a, b in zip(q, r, strict=True)])
        if y is None:
            raise UnprovenError
        gap = rho**2 - form(cosine, y)
        if abs(gap) <= number("1e-40") * rho**2 + number(VANISHED) * max(y) ** 2 / 10:
            return y
        low, high = (level, high) if gap > 0 else (low, level)
        change = _change(cosine, y, r, gap)
        level = (low + high) / 2 if change is None else level + change
        if not low <= level <= high:
            level = (low + high) / 2
    raise UnprovenError


def _change(cosine: Matrix, y: Vector, r: Vector, gap: Number) -> Number | None:
    """Return the change of the level after which the distance is rho.

    The active constraints are assumed not to change.
    """
    mp = require_mpmath().mp
    support = [k for k, v in enumerate(y) if v > 0]
    a = solve(cosine, support, r) if support else None
    if a is None:
        return None
    along, across = dot(y, apply(cosine, a)), form(cosine, a)
    under = along**2 + across * gap
    return gap / (along + mp.sqrt(max(under, number(0))))
