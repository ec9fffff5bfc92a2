"""Small linear algebra in 50 digits for the oracles: solves, supports, complementarity."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from crossgrad_operators.stress.exact import Matrix, Number, require_mpmath

Vector = list[Number]

#: Relative size of a pivot that counts as zero; exact singularity shows at about 1e-50.
SINGULAR = "1e-35"
#: Up to this many views all supports are tried.
ENUMERATED = 8


def dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """a.b."""
    return require_mpmath().mp.fdot(zip(a, b, strict=True))


def apply(matrix: Matrix, x: Sequence[Number]) -> Vector:
    """M x."""
    return [dot(row, x) for row in matrix]


def form(matrix: Matrix, x: Sequence[Number]) -> Number:
    """The quadratic form x^T M x."""
    return dot(x, apply(matrix, x))


def supports(count: int) -> Iterator[tuple[int, ...]]:
    """All non-empty subsets of range(count)."""
    for size in range(1, count + 1):
        yield from combinations(range(count), size)


def solve(matrix: Matrix, support: Sequence[int], right: Sequence[Number]) -> Vector | None:
    """Solution x of (M x)_S = right_S, zero outside the support S; None where M_SS is singular."""
    mp = require_mpmath().mp
    size = len(support)
    # In units of the diagonal, so that no ratio of norms looks singular.
    unit = {i: mp.sqrt(matrix[i][i]) for i in support}
    rows = [
        [matrix[i][j] / unit[i] / unit[j] for j in support] + [right[i] / unit[i]] for i in support
    ]
    for column in range(size):
        pivot = max(range(column, size), key=lambda r: abs(rows[r][column]))
        if abs(rows[pivot][column]) <= mp.mpf(SINGULAR):
            return None
        rows[column], rows[pivot] = rows[pivot], rows[column]
        for other in range(size):
            if other != column and rows[other][column]:
                factor = rows[other][column] / rows[column][column]
                rows[other] = [
                    a - factor * b for a, b in zip(rows[other], rows[column], strict=True)
                ]
    x = [mp.mpf(0)] * len(matrix)
    for place, i in enumerate(support):
        x[i] = rows[place][size] / rows[place][place] / unit[i]
    return x


def null_vector(matrix: Matrix, support: Sequence[int]) -> Vector | None:
    """Vector x on a minimal dependent support with (M x)_S = 0; None where M_SS is regular."""
    mp = require_mpmath().mp
    *rest, last = support
    right = [-row[last] for row in matrix]
    x = solve(matrix, rest, right) if rest else [mp.mpf(0)] * len(matrix)
    if x is None:
        return None
    x[last] = mp.mpf(1)
    left = form(matrix, x)
    return x if abs(left) <= mp.mpf(SINGULAR) * max(abs(v) for v in x) ** 2 else None


def complementary(matrix: Matrix, offset: Sequence[Number]) -> Vector | None:
    """Solution x >= 0 with s = M x + offset >= 0 and x.s = 0: the optimality conditions of a QP.

    Murty's least-index pivoting, which ends for every positive definite M; None where it does not
    (M is singular), up to `ENUMERATED` rows all supports are tried instead.
    """
    if len(matrix) <= ENUMERATED:
        return _complementary_by_enumeration(matrix, offset)
    inside: set[int] = set()
    for _ in range(5000):
        x = _with_support(matrix, offset, sorted(inside))
        if x is None:
            return None
        wrong = [i for i, s in enumerate(_slack(matrix, offset, x)) if _violates(i, inside, x, s)]
        if not wrong:
            return x
        inside ^= {wrong[0]}
    return None


def _complementary_by_enumeration(matrix: Matrix, offset: Sequence[Number]) -> Vector | None:
    for support in ((), *supports(len(matrix))):
        x = _with_support(matrix, offset, support)
        if x is not None and not any(
            _violates(i, set(support), x, s) for i, s in enumerate(_slack(matrix, offset, x))
        ):
            return x
    return None


def _with_support(
    matrix: Matrix, offset: Sequence[Number], support: Sequence[int]
) -> Vector | None:
    if not support:
        return [require_mpmath().mp.mpf(0)] * len(matrix)
    return solve(matrix, support, [-o for o in offset])


def _slack(matrix: Matrix, offset: Sequence[Number], x: Sequence[Number]) -> Vector:
    return [m + o for m, o in zip(apply(matrix, x), offset, strict=True)]


def _violates(i: int, inside: set[int], x: Sequence[Number], slack: Number) -> bool:
    tolerance = require_mpmath().mp.mpf(SINGULAR) * max(1, *(abs(v) for v in x))
    return bool(x[i] < -tolerance) if i in inside else bool(slack < -tolerance)
