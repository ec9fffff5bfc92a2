"""Oracles of the methods that ask for the nearest point of a polyhedron, in 50 digits.

The operators follow active sets in float64, on cosines that a ridge makes definite; here they are
followed exactly, and every answer is checked against the optimality conditions, which have one
solution: whatever way led there, it is the minimum. Weights that are not unique (the gradients
depend on each other) are those of independent gradients.
"""

from collections.abc import Sequence

from crossgrad_operators.stress.algebra import Vector, apply, complementary, dot, form, solve
from crossgrad_operators.stress.exact import Matrix, Number, number, require_mpmath
from crossgrad_operators.stress.oracles import (
    OPPOSITE,
    Question,
    column_sums,
    cosines,
    is_noise,
    lengths,
    zeros,
)
from crossgrad_operators.stress.solvers import UnprovenError

#: Square of |sum x_k e_k| over the largest x_k^2 that 50 digits leave of a sum that is zero.
VANISHED = "1e-45"
#: Levels that are tried for CAGrad.
LEVELS = 400


def _vanishes(cosine: Matrix, x: Vector) -> bool:
    """Whether a combination is zero; of two directions, also where they count as opposite."""
    largest = max(abs(v) for v in x)
    exactly = form(cosine, x) <= number(VANISHED) * largest**2
    return exactly or (len(x) == 2 and is_noise(cosine, x))  # noqa: PLR2004


def _projection(cosine: Matrix, b: Vector) -> Vector:
    """Coefficients of the projection of sum b_k e_k on the cone {x: x.e_l >= 0}."""
    y = complementary(cosine, apply(cosine, b))
    if y is None:
        raise UnprovenError
    x = [u + v for u, v in zip(b, y, strict=True)]
    return zeros(len(b)) if _vanishes(cosine, x) else x


def upgrad(question: Question) -> Vector:
    """Each gradient projected, over K."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    rows = []
    for k in range(question.count):
        x = _projection(cosine, [number(int(i == k)) for i in range(question.count)])
        rows.append([v * n[k] / n[i] / question.views for i, v in enumerate(x)])
    return column_sums(rows)


def dualproj(question: Question) -> Vector:
    """The mean projected."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    longest = max(n)
    x = _projection(cosine, [v / longest for v in n])
    return [v * longest / n[k] / question.views for k, v in enumerate(x)]


def mgda(question: Question) -> Vector:
    """Shortest convex combination."""
    n, cosine = lengths(question.gramian), cosines(question.gramian)
    r = [min(n) / v for v in n]
    x = shortest(cosine, r)
    return (
        zeros(question.count)
        if _vanishes(cosine, x)
        else [v * w for v, w in zip(x, r, strict=True)]
    )


def shortest(cosine: Matrix, r: Sequence[Number]) -> Vector:
    """Coefficients x >= 0 with r.x = 1 of the shortest sum x_k e_k.

    They are those of the smallest |sum x_k e_k|^2 + (r.x - 1)^2, up to a factor; that has a
    solution even if 0 is a convex combination.
    """
    size = range(len(r))
    matrix = [[cosine[i][j] + r[i] * r[j] for j in size] for i in size]
    x = complementary(matrix, [-v for v in r])
    if x is None:
        raise UnprovenError
    total = dot(x, r)
    return [v / total for v in x]


def cagrad(question: Question) -> Vector:
    """g_0 + c |g_0| g_w / |g_w|, from the nearest point to g_0 where no g_k.d is below a level."""
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
    """Multipliers of the nearest point to the base with e_k.d >= level r_k, at distance rho.

    None where 0 is a convex combination and the level 0 is reached within that distance: then no
    level above is, and the direction is undefined.
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
    """The multipliers at which the distance is rho; every level of the interval can be met."""
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
    """Change of the level that closes the gap of the squared distance on the present face."""
    mp = require_mpmath().mp
    support = [k for k, v in enumerate(y) if v > 0]
    a = solve(cosine, support, r) if support else None
    if a is None:
        return None
    along, across = dot(y, apply(cosine, a)), form(cosine, a)
    under = along**2 + across * gap
    return gap / (along + mp.sqrt(max(under, number(0))))
