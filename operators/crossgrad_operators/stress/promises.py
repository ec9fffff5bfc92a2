"""The accuracy that each operator guarantees, and the gradients for which it is guaranteed.

Inside the set of these gradients, the relative error is at most `PROMISED` u kappa. Here u is the
unit roundoff of the gradients' type, and kappa = max |w_k| |g_k| / |result|. Outside the set, the
result is finite. The length of the result is at most a stated factor times the longest gradient. A
test checks that docs/operators.md lists every operator and its factor.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_operators.stress.exact import Matrix, form, number, pivots
from crossgrad_operators.stress.solvers import shortest

#: Guaranteed relative error inside the set, in units of u kappa.
PROMISED: Final = 8.0
#: Unit roundoff of float64.
FLOAT64: Final = 2.0**-53
#: The gradients determine the result accurately enough if kappa u is at most this value.
DETERMINED: Final = 0.1
#: Directions are nearly dependent if a pivot is between these two values.
DEPENDENT: Final = 1e-29
INDEPENDENT: Final = 1e-13
#: Upper limit of the pivots of nearly dependent directions, for operators that divide by every
#: eigenvalue.
REGULAR: Final = 1e-8
#: Rounding may increase a bound of 1 by up to this amount.
SLIGHTLY: Final = 1e-3
#: Up to this ratio of norms, CAGrad can distinguish directions that cancel from directions that do
#: not.
COMPARABLE: Final = 1e8
#: Results are continuous if the distance from the origin to the convex hull of the directions is at
#: least this value.
APART: Final = 1e-7


@dataclass(frozen=True, eq=False)
class Facts:
    """The quantities that define the sets, for n gradients that are not zero and their result.

    Attributes:
        norms: [n] lengths of the gradients.
        cosines: [n][n] cosines of the gradients, with 50 digits.
        weights: [n] exact weights, rounded to float64.
        length: Length |u| of the exact result u.
        unit: Unit roundoff of the gradients' type.
    """

    norms: NDArray[np.float64]
    cosines: Matrix
    weights: NDArray[np.float64]
    length: float
    unit: float

    @property
    def longest(self) -> float:
        """Length of the longest gradient."""
        return float(self.norms.max(initial=0.0))

    @property
    def largest(self) -> float:
        """Length of the longest weighted gradient, max |w_k| |g_k|."""
        return float(np.abs(self.weights * self.norms).max(initial=0.0))

    @property
    def kappa(self) -> float:
        """Condition number max |w_k| |g_k| / |u|, but at least 1.

        If the exact result is zero, the condition number is 0.
        """
        if not self.weights.any():
            return 0.0
        return max(self.largest / self.length, 1.0) if self.length else float("inf")

    @property
    def ratio(self) -> float:
        """Length of the longest gradient divided by the length of the shortest gradient."""
        return self.longest / float(self.norms.min(initial=np.inf))

    @cached_property
    def distance(self) -> float:
        """Distance from the origin to the convex hull of the unit gradients g_k / |g_k|.

        Raises:
            UnprovenError: The nearest point of the convex hull was not found.
        """
        if not self.cosines:
            return 0.0
        x = shortest(self.cosines, [number(1)] * len(self.cosines))
        return sqrt(max(form(self.cosines, x), 0))

    @cached_property
    def dependence(self) -> list[float]:
        """Pivots of the Cholesky factorization of the cosines, in descending order."""
        return [float(pivot) for pivot in pivots(self.cosines)]

    @property
    def sines(self) -> list[float]:
        """1 - cos^2 for all pairs of gradients."""
        pairs = (row[j] for i, row in enumerate(self.cosines) for j in range(i))
        return [float((1 - cosine) * (1 + cosine)) for cosine in pairs]

    @property
    def partial(self) -> float:
        """Sum of the lengths of all partial sums and all terms, relative to a length.

        The partial sums are w_1 g_1 + w_2 g_2, ..., u, and the terms are w_k g_k.

        The length for the comparison is max(|u|, max |w_k g_k|).

        The value is a bound for the rounding errors of all products and additions, in units of u
        kappa.
        """
        # Divide by the largest term first, because its square may overflow float64.
        unit = self.largest or 1.0
        terms = self.weights * self.norms / unit
        cosines = np.array(self.cosines, dtype=np.float64).reshape(len(terms), len(terms))
        total = float(np.abs(terms).sum())
        for last in range(2, len(terms) + 1):
            x = terms[:last]
            total += max(float(x @ cosines[:last, :last] @ x), 0.0) ** 0.5
        return total / max(self.length / unit, 1.0)


def default_bound(facts: Facts) -> float:
    """Return 8, or a larger value for many views.

    The larger value is the rounding error of the weighted sum plus 2 for the weights.
    """
    return max(PROMISED, facts.partial + 2.0)


def pairwise_bound(facts: Facts) -> float:
    """Return the default bound, but twice as large for float64 gradients.

    For float64 gradients, Gramians are only as precise as the gradients.
    """
    return default_bound(facts) * (1.0 if facts.unit > FLOAT64 else 2.0)


def views_bound(facts: Facts) -> float:
    """Return the number of views, but at least 8.

    While elements with equal signs are summed, the partial sums never become smaller.
    """
    return max(PROMISED, float(len(facts.norms)))


def everywhere(_facts: Facts) -> bool:
    """Return True, because the set contains all Gramians."""
    return True


def determined(facts: Facts) -> bool:
    """Return True if the result is zero, or if kappa u is at most 0.1."""
    return facts.kappa * facts.unit <= DETERMINED


def clear(facts: Facts) -> bool:
    """Return True if `determined` is True and no directions are nearly dependent.

    Exactly dependent directions are allowed.
    """
    return determined(facts) and not _any_between(
        [*facts.sines, *facts.dependence], DEPENDENT, INDEPENDENT
    )


def independent(facts: Facts) -> bool:
    """Return True if `determined` is True and no directions are nearly dependent.

    For one or two directions, dependence is not tested.
    """
    several = len(facts.norms) > 2  # noqa: PLR2004
    return determined(facts) and not (
        several and _any_between(facts.dependence, DEPENDENT, REGULAR)
    )


def comparable(facts: Facts) -> bool:
    """Return True if `clear` is True and norms are comparable.

    If the convex hull of the directions contains the origin, the ratio of norms must be at most
    1e8.
    """
    return clear(facts) and (facts.ratio <= COMPARABLE or facts.distance >= APART)


def hull_apart(facts: Facts) -> bool:
    """Return True if the convex hull of the directions is not near the origin."""
    return facts.distance >= APART


def _any_between(values: Sequence[float], low: float, high: float) -> bool:
    return any(low < value < high for value in values)


@dataclass(frozen=True)
class Promise:
    """The guarantee of one operator.

    Attributes:
        words: Description of the set, with formulas.
        factor_words: The factor outside the set, as a formula.
        factor: Function from K to the largest |u| / (longest gradient) outside the set.
        inside: Function that returns True if a Gramian belongs to the set.
        bound: Function that returns the largest error inside the set, in units of u kappa.
        continuous: Function that returns True if the result is continuous in the gradients.
    """

    words: str
    factor_words: str
    factor: Callable[[int], float]
    inside: Callable[[Facts], bool] = determined
    bound: Callable[[Facts], float] = default_bound
    continuous: Callable[[Facts], bool] = everywhere


#: Guarantee of operators for which no other guarantee is listed.
ALL: Final = Promise("all gradients", "infinity", lambda _views: float("inf"), everywhere)
_DETERMINED: Final = "all Gramians with kappa u <= 0.1, and all Gramians whose exact result is zero"
_CLEAR: Final = (
    f"{_DETERMINED}, except Gramians with nearly dependent directions: a pivot of the Cholesky "
    "factorization of the cosines (50 digits, largest first), or 1 - cos^2 of a pair, lies between "
    "1e-29 and 1e-13"
)
_REGULAR: Final = (
    f"{_DETERMINED}, except Gramians of more than two views with a pivot of the Cholesky "
    "factorization of the cosines between 1e-29 and 1e-8"
)
_COMPARABLE: Final = (
    f"{_CLEAR}. If a convex combination of the directions vanishes, the longest gradient must be "
    "at most 1e8 times the shortest"
)


def _plain(words: str, factor: Callable[[int], float]) -> Promise:
    """Return the guarantee of an operator whose set has no further restrictions."""
    return Promise(_DETERMINED, words, factor)


_SUM: Final = _plain("K", float)
_PAIRS: Final = Promise(_DETERMINED, "K", float, bound=pairwise_bound)
#: Name of an operator -> its guarantee.
PROMISES: Final[Mapping[str, Promise]] = {
    "sum": _SUM,
    "mean": _plain("1", lambda _views: 1.0),
    "gradnorm": _SUM,
    "preconditioner": _plain("1e4 K", lambda views: 1e4 * views),
    "chain": Promise(_DETERMINED, "1e4 K", lambda k: 1e4 * k, bound=pairwise_bound),
    "symmetric": _PAIRS,
    "anchors": _PAIRS,
    "dispatch": _PAIRS,
    "pcgrad": _PAIRS,
    "confgate": _PAIRS,
    "soft": _PAIRS,
    "gradvac": Promise(
        _DETERMINED, "K 22.4^(K - 1)", lambda k: k * 22.4 ** (k - 1), bound=pairwise_bound
    ),
    "nash": _plain("sqrt(K)", lambda views: 1.001 * float(views) ** 0.5),
    "imtl-g": Promise(_REGULAR, "7.1e5 K", lambda views: 7.1e5 * views, independent),
    "graddrop": Promise("all gradients", "K", float, everywhere, views_bound),
    "aligned": _plain("1", lambda _views: 1.0),
    "mgda": Promise(_CLEAR, "1", lambda _views: 1.0 + SLIGHTLY, clear),
    "upgrad": Promise(_CLEAR, "1", lambda _views: 1.0 + SLIGHTLY, clear, continuous=hull_apart),
    "dualproj": Promise(_CLEAR, "1", lambda _views: 1.0 + SLIGHTLY, clear, continuous=hull_apart),
    "cagrad": Promise(
        _COMPARABLE, "1 + c", lambda _views: 1.5 + SLIGHTLY, comparable, continuous=hull_apart
    ),
}


def promise_of(name: str) -> Promise:
    """Return the guarantee of the built-in operator with this name."""
    return PROMISES.get(name, ALL)
