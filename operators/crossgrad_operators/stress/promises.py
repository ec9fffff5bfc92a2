"""The promises of each operator, and the set on which they hold: the one place that says so.

Inside the set the relative error is at most `PROMISED` u kappa, u the unit roundoff of the
gradients' type and kappa = max |w_k| |g_k| / |u|; outside the result is finite and at most a stated
factor times the longest gradient. docs/operators.md repeats the words, and a test holds it to that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_operators.stress.search.numba_kernels.convex import shortest
from crossgrad_operators.stress.search.numba_kernels.measure import pivots_of

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Relative error that is promised inside the set, in units of u kappa.
PROMISED: Final = 8.0
#: Unit roundoff of float64.
FLOAT64: Final = 2.0**-53
#: kappa u up to which the gradients determine the result.
DETERMINED: Final = 0.1
#: Pivots between these are of directions that nearly depend on each other.
DEPENDENT: Final = 1e-29
INDEPENDENT: Final = 1e-13
#: The same for methods that divide by every eigenvalue.
REGULAR: Final = 1e-8
#: What rounding may add to a bound of 1.
SLIGHTLY: Final = 1e-3
#: Ratio of norms up to which CAGrad tells directions that cancel from others.
COMPARABLE: Final = 1e8
#: Distances of zero from the directions' hull from which on solutions are continuous.
APART: Final = 1e-7


@dataclass(frozen=True, eq=False)
class Facts:
    """The terms in which sets are stated: B Gramians, as norms and cosines, and exact answers.

    Attributes:
        norms: [B, K] lengths of the gradients, 0 where a view is not present.
        directions: [B, K, K, 2] cosines in 32 digits.
        present: [B, K].
        weights: [B, K] exact weights, rounded.
        length: [B] |u|.
        unit: Unit roundoff of the gradients' type.
    """

    norms: Floats
    directions: Floats
    present: Flags
    weights: Floats
    length: Floats
    unit: float

    @property
    def cosines(self) -> Floats:
        """[B, K, K]."""
        return self.directions[..., 0]

    @property
    def longest(self) -> Floats:
        """[B] length of the longest gradient."""
        return np.asarray(self.norms.max(axis=1, initial=0.0))

    @property
    def largest(self) -> Floats:
        """[B] max |w_k| |g_k|."""
        return np.asarray(np.abs(self.weights * self.norms).max(axis=1, initial=0.0))

    @property
    def kappa(self) -> Floats:
        """[B] max |w_k| |g_k| / |u|, at least 1; 0 where the exact result is zero."""
        zero = ~self.weights.any(axis=1)
        with np.errstate(all="ignore"):
            return np.where(zero, 0.0, np.maximum(self.largest / self.length, 1.0))

    @property
    def ratio(self) -> Floats:
        """[B] the longest over the shortest gradient that is not zero."""
        norms = np.where(self.present, self.norms, np.inf).min(axis=1, initial=np.inf)
        return np.asarray(self.longest / norms)

    @cached_property
    def distance(self) -> Floats:
        """[B] distance of zero from the convex hull of the directions g_k / |g_k|."""
        norms = np.zeros((*self.norms.shape, 2))
        norms[..., 0] = self.present
        weights, _ = shortest(norms, np.ascontiguousarray(self.directions), self.present)
        x = weights[..., 0]
        square = np.einsum("bi,bij,bj->b", x, self.cosines, x)
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    @cached_property
    def pivots(self) -> Floats:
        """[B, K] those of the cosines' Cholesky factor, the largest first."""
        return np.asarray(pivots_of(np.ascontiguousarray(self.directions)))

    @property
    def sines(self) -> Floats:
        """[B, K, K] 1 - cos^2 of pairs of gradients; 1 where one is not present."""
        high, low = self.cosines, self.directions[..., 1]
        # 1 - |cos| is exact in two numbers.
        sign = np.where(high < 0, -1.0, 1.0)
        return np.asarray(((1.0 - sign * high) - sign * low) * (1.0 + np.abs(high)))

    @property
    def partial(self) -> Floats:
        """[B] |w_1 g_1 + w_2 g_2| + ... + |u| and all |w_k g_k|, over max(|u|, max |w_k g_k|).

        What rounding of each product and of each addition comes to, at most, in units of u kappa.
        """
        # In units of the largest, whose square may be too much for float64.
        unit = np.where(self.largest > 0, self.largest, 1.0)
        terms = self.weights * self.norms / unit[:, None]
        total = np.abs(terms).sum(axis=1)
        for last in range(2, terms.shape[1] + 1):
            x = terms[:, :last]
            square = np.einsum("bi,bij,bj->b", x, self.cosines[:, :last, :last], x)
            total += np.sqrt(np.maximum(square, 0.0))
        return np.asarray(total / np.maximum(self.length / unit, 1.0))


def usual_bound(facts: Facts) -> Floats:
    """Eight, or where the weighted sum alone may lose more, that and two for the weights."""
    return np.maximum(PROMISED, facts.partial + 2.0)


def pairwise_bound(facts: Facts) -> Floats:
    """Twice that in float64, where the Gramians of pairs are as coarse as the gradients."""
    return usual_bound(facts) * (1.0 if facts.unit > FLOAT64 else 2.0)


def views_bound(facts: Facts) -> Floats:
    """One per view, at least eight: sums of one sign never get shorter."""
    return np.asarray(np.maximum(PROMISED, facts.present.sum(axis=1)))


def everywhere(facts: Facts) -> Flags:
    """Every Gramian."""
    return np.ones(len(facts.norms), np.bool_)


def determined(facts: Facts) -> Flags:
    """The result is zero, or kappa u is at most 0.1."""
    return np.asarray(facts.kappa * facts.unit <= DETERMINED)


def clear(facts: Facts) -> Flags:
    """As `determined`, and directions depend on each other exactly or not nearly."""
    sines = facts.sines.reshape(len(facts.norms), -1)
    squares = np.concatenate([facts.pivots, sines], axis=1)
    nearly = (squares > DEPENDENT) & (squares < INDEPENDENT)
    return np.asarray(determined(facts) & ~nearly.any(axis=1))


def independent(facts: Facts) -> Flags:
    """As `determined`, and directions of more than two views do not nearly depend."""
    nearly = (facts.pivots > DEPENDENT) & (facts.pivots < REGULAR)
    several = facts.present.sum(axis=1) > 2  # noqa: PLR2004
    return np.asarray(determined(facts) & ~(several & nearly.any(axis=1)))


def comparable(facts: Facts) -> Flags:
    """As `clear`; where zero is in the hull of the directions the norms have ratios up to 1e8."""
    return np.asarray(clear(facts) & ((facts.distance >= APART) | (facts.ratio <= COMPARABLE)))


def hull_apart(facts: Facts) -> Flags:
    """Zero is not near the hull of the directions."""
    return np.asarray(facts.distance >= APART)


@dataclass(frozen=True)
class Promise:
    """The promise of one operator.

    Attributes:
        words: The set, in words and formula.
        factor_words: The factor as a formula.
        factor: |u| / (longest gradient) that is not exceeded outside the set, for K views.
        inside: Facts -> [B] which Gramians belong to the set.
        bound: Facts -> [B] error that is not exceeded inside, in units of u kappa.
        continuous: Facts -> [B] where the method is continuous in the gradients.
    """

    words: str
    factor_words: str
    factor: Callable[[int], float]
    inside: Callable[[Facts], Flags] = determined
    bound: Callable[[Facts], Floats] = usual_bound
    continuous: Callable[[Facts], Flags] = everywhere


#: What is promised of an operator that nothing is stated for.
ALL: Final = Promise("all gradients", "infinity", lambda _views: float("inf"), everywhere)
_DETERMINED: Final = "all Gramians with kappa u <= 0.1, and those whose exact result is zero"
_CLEAR: Final = (
    "of these, those whose directions depend on each other exactly or not nearly: no pivot of the "
    "cosines' Cholesky factor (32 digits, largest first), and no 1 - cos^2 of a pair, lies between "
    "1e-29 and 1e-13"
)
_REGULAR: Final = (
    "of these, those of up to two views, and those with no pivot of the cosines' Cholesky factor "
    "between 1e-29 and 1e-8"
)
_COMPARABLE: Final = (
    f"{_CLEAR}; and where a convex combination of the directions vanishes, the longest gradient is "
    "at most 1e8 times the shortest"
)


def _plain(words: str, factor: Callable[[int], float]) -> Promise:
    """An operator without exceptions."""
    return Promise(_DETERMINED, words, factor)


_SUM: Final = _plain("K", float)
_PAIRS: Final = Promise(_DETERMINED, "K", float, bound=pairwise_bound)
#: Operator name -> what is promised of it.
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
    """What is promised of the built-in of that name."""
    return PROMISES.get(name, ALL)
