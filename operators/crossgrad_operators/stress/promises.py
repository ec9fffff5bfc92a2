"""What is promised of each operator, and on which set: the one place that says so.

Inside the set the relative error is at most `PROMISED` u kappa, u the unit roundoff of the
gradients' type and kappa = max |w_k| |g_k| / |u|; outside the result is finite and at most a stated
factor times the longest gradient. docs/operators.md repeats the words, and a test holds it to that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Relative error that is promised inside the set, in units of u kappa.
PROMISED: Final = 8.0


@dataclass(frozen=True, eq=False)
class Facts:
    """What sets are stated in: B Gramians, as norms and cosines, and their exact answers.

    Attributes:
        norms: [B, K] lengths of the gradients, 0 where a view is not present.
        cosines: [B, K, K].
        present: [B, K].
        weights: [B, K] exact weights, rounded.
        length: [B] |u|.
        unit: Unit roundoff of the gradients' type.
    """

    norms: Floats
    cosines: Floats
    present: Flags
    weights: Floats
    length: Floats
    unit: float

    @property
    def longest(self) -> Floats:
        """[B] length of the longest gradient."""
        return np.asarray(self.norms.max(axis=1, initial=0.0))

    @property
    def largest(self) -> Floats:
        """[B] max |w_k| |g_k|."""
        return np.asarray(np.abs(self.weights * self.norms).max(axis=1, initial=0.0))


def _usual(facts: Facts) -> Floats:
    return np.full(len(facts.norms), PROMISED)


def everywhere(facts: Facts) -> Flags:
    """Every Gramian."""
    return np.ones(len(facts.norms), np.bool_)


@dataclass(frozen=True)
class Promise:
    """What is promised of one operator.

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
    inside: Callable[[Facts], Flags] = everywhere
    bound: Callable[[Facts], Floats] = _usual
    continuous: Callable[[Facts], Flags] = everywhere


#: What is promised of an operator that nothing is stated for.
ALL: Final = Promise("all gradients", "infinity", lambda _views: inf)
#: Operator name -> what is promised of it.
PROMISES: Final[Mapping[str, Promise]] = {}


def promise_of(name: str) -> Promise:
    """What is promised of the built-in of that name."""
    return PROMISES.get(name, ALL)
