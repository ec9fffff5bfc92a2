"""Linear algebra of a few rows in 32 digits."""

import numpy as np

from crossgrad_core.jit import strict_part
from crossgrad_core.stress.search.numba_kernels.doubled import (
    Flags,
    Floats,
    Indices,
    Pair,
    add,
    at,
    divide,
    entry,
    minus,
    multiply,
    root,
    two_product,
)

#: Pivots of matrices of unit diagonal up to this are zero: their columns depend on earlier ones.
SINGULAR = 1e-27
#: A slack counts as negative beyond this share of the largest coefficient.
TOLERANCE = 1e-25


@strict_part
def dot(a: Floats, b: Floats) -> Pair:
    """a.b of vectors [N, 2]."""
    total = (0.0, 0.0)
    for k in range(a.shape[0]):
        if (a[k, 0] != 0.0) and (b[k, 0] != 0.0):
            total = add(total, multiply(at(a, k), at(b, k)))
    return total


@strict_part
def form(matrix: Floats, x: Floats) -> Pair:
    """x^T M x."""
    total = (0.0, 0.0)
    for k in range(x.shape[0]):
        if x[k, 0] != 0.0:
            total = add(total, multiply(at(x, k), dot(matrix[k], x)))
    return total


@strict_part
def negated(x: Floats) -> Floats:
    """The opposite of a vector [N, 2]; loops compile faster than expressions of arrays."""
    result = np.empty((x.shape[0], 2))
    for k in range(x.shape[0]):
        result[k, 0], result[k, 1] = -x[k, 0], -x[k, 1]
    return result


@strict_part
def _assign(x: Floats, value: Floats) -> None:
    for k in range(x.shape[0]):
        x[k, 0], x[k, 1] = value[k, 0], value[k, 1]


@strict_part
def places(flags: Flags) -> Indices:
    """Where flags are set."""
    count = 0
    result = np.empty(flags.shape[0], np.int64)
    for k in range(flags.shape[0]):
        if flags[k]:
            result[count] = k
            count += 1
    return result[:count]


@strict_part
def _any(flags: Flags) -> bool:
    found = False
    for flag in flags:
        found |= flag
    return found


@strict_part
def largest(x: Floats) -> float:
    """The largest magnitude of a vector."""
    size = 0.0
    for k in range(x.shape[0]):
        size = max(size, abs(x[k, 0]))
    return size


@strict_part
def directions(rows: Floats, present: Flags, norms: Floats, cosines: Floats) -> None:
    """Fills norms [K, 2] and cosines [K, K, 2] of float64 rows [K, P]; zero where not present."""
    views, size = rows.shape
    norms[:] = 0.0
    cosines[:] = 0.0
    for i in range(views):
        for j in range(i + 1):
            if present[i] and present[j]:
                total = (0.0, 0.0)
                for p in range(size):
                    total = add(total, two_product(rows[i, p], rows[j, p]))
                cosines[i, j, 0], cosines[i, j, 1] = total
        norms[i, 0], norms[i, 1] = root(entry(cosines, i, i))
    for i in range(views):
        for j in range(i):
            if present[i] and present[j]:
                value = divide(divide(entry(cosines, i, j), at(norms, i)), at(norms, j))
                cosines[i, j, 0], cosines[i, j, 1] = value
                cosines[j, i, 0], cosines[j, i, 1] = value
        cosines[i, i, 0] = 1.0 if present[i] else 0.0
        cosines[i, i, 1] = 0.0


@strict_part
def solve(matrix: Floats, chosen: Indices, count: int, right: Floats, out: Floats) -> float:
    """Solves M_SS x = r_S by L D L^T; x is zero for members that depend on earlier ones.

    Args:
        matrix: [K, K, 2], positive semi-definite.
        chosen: [K] the first `count` entries are the members of S.
        count: Size of S.
        right: [K, 2] right-hand side.
        out: [K, 2] solution, zero outside S.

    Returns:
        The smallest pivot, zero where some member depends on earlier ones.
    """
    lower = np.zeros((count, count, 2))
    pivots = np.zeros((count, 2))
    smallest = np.inf
    for j in range(count):
        total = entry(matrix, chosen[j], chosen[j])
        for k in range(j):
            if pivots[k, 0] > 0.0:
                square = multiply(entry(lower, j, k), entry(lower, j, k))
                total = add(total, minus(multiply(square, at(pivots, k))))
        if total[0] <= SINGULAR:
            smallest = 0.0
            continue
        smallest = min(smallest, total[0])
        pivots[j, 0], pivots[j, 1] = total
        for i in range(j + 1, count):
            value = entry(matrix, chosen[i], chosen[j])
            for k in range(j):
                if pivots[k, 0] > 0.0:
                    term = multiply(entry(lower, j, k), at(pivots, k))
                    value = add(value, minus(multiply(entry(lower, i, k), term)))
            lower[i, j, 0], lower[i, j, 1] = divide(value, total)
    _substituted(lower, pivots, chosen, count, right, out)
    return smallest


@strict_part
def _substituted(
    lower: Floats, pivots: Floats, chosen: Indices, count: int, right: Floats, out: Floats
) -> None:
    x = np.zeros((count, 2))
    for i in range(count):
        value = at(right, chosen[i])
        for k in range(i):
            value = add(value, minus(multiply(entry(lower, i, k), at(x, k))))
        x[i, 0], x[i, 1] = value if pivots[i, 0] > 0.0 else (0.0, 0.0)
    out[:] = 0.0
    for i in range(count - 1, -1, -1):
        if pivots[i, 0] > 0.0:
            value = divide(at(x, i), at(pivots, i))
            for k in range(i + 1, count):
                value = add(value, minus(multiply(entry(lower, k, i), at(x, k))))
            x[i, 0], x[i, 1] = value
            out[chosen[i], 0], out[chosen[i], 1] = value


@strict_part
def complementary(matrix: Floats, offset: Floats, members: Flags, x: Floats) -> float:
    """Finds x >= 0 with s = M x + offset >= 0 and x.s = 0 (Lawson and Hanson 1974).

    The offset lies in the range of M, so that a column which would enter never depends on those
    that are in.

    Args:
        matrix: [K, K, 2], positive semi-definite.
        offset: [K, 2].
        members: [K] rows that take part; x is zero elsewhere.
        x: [K, 2] solution.

    Returns:
        The smallest pivot of the solution's support, or -1 where none was found.
    """
    views = x.shape[0]
    inside = np.zeros(views, np.bool_)
    barred = np.zeros(views, np.bool_)
    chosen = np.zeros(views, np.int64)
    right = negated(offset)
    trial = np.zeros((views, 2))
    x[:] = 0.0
    count, pivot = 0, 1.0
    for _ in range(20 * views):
        entering = _most_violated(matrix, offset, members, inside, barred, x)
        if entering < 0:
            return -1.0 if _any(barred) else pivot
        chosen[count] = entering
        count += 1
        inside[entering] = True
        first = True
        while count:
            pivot = solve(matrix, chosen, count, right, trial)
            if first and trial[entering, 0] <= 0.0:
                # Rounding has the last word on this one.
                barred[entering] = True
            first = False
            step, leaving = 1.0, -1
            for i in range(count):
                k = chosen[i]
                if trial[k, 0] <= 0.0:
                    share = x[k, 0] / (x[k, 0] - trial[k, 0]) if x[k, 0] > 0.0 else 0.0
                    if share < step or leaving < 0:
                        step, leaving = share, i
            if leaving < 0:
                _assign(x, trial)
                barred[:] = False
                break
            for i in range(count):
                k = chosen[i]
                gap = add(at(trial, k), minus(at(x, k)))
                x[k, 0], x[k, 1] = add(at(x, k), multiply((step, 0.0), gap))
            x[chosen[leaving]] = 0.0
            inside[chosen[leaving]] = False
            count -= 1
            for i in range(leaving, count):
                chosen[i] = chosen[i + 1]
    return -1.0


@strict_part
def _most_violated(
    matrix: Floats, offset: Floats, members: Flags, inside: Flags, barred: Flags, x: Floats
) -> int:
    worst, entering = -TOLERANCE * max(largest(x), largest(offset)), -1
    for k in range(x.shape[0]):
        if members[k] and not inside[k] and not barred[k]:
            slack = add(dot(matrix[k], x), at(offset, k))[0]
            if slack < worst:
                worst, entering = slack, k
    return entering
