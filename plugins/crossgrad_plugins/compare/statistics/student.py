"""Student's t for the mean of a few pairs."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Nobody trains more pairs than this for one comparison.
MOST_PAIRS: Final = 1000


@dataclass(frozen=True)
class Law:
    """Student's law of the mean of which a sample was drawn.

    Attributes:
        center: Mean of the sample.
        error: Its standard error; 0 where all values are the same.
        freedom: Degrees of freedom.
    """

    center: float
    error: float
    freedom: int

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> "Law":
        """From two values or more."""
        error = float(values.std(ddof=1)) / sqrt(len(values))
        return cls(float(values.mean()), error, len(values) - 1)

    def interval(self, level: float) -> tuple[float, float]:
        """The two-sided interval of a level such as 0.95."""
        half = quantile(0.5 + level / 2.0, self.freedom) * self.error
        return self.center - half, self.center + half

    def lower_tail(self, border: float) -> float:
        """p-value of a mean that is at most `border`."""
        return self._tail(self.center - border)

    def upper_tail(self, border: float) -> float:
        """p-value of a mean that is at least `border`."""
        return self._tail(border - self.center)

    def _tail(self, distance: float) -> float:
        from scipy.special import stdtr

        if self.error == 0.0:
            return 0.0 if distance > 0.0 else 1.0
        return float(stdtr(self.freedom, -distance / self.error))


def quantile(probability: float, freedom: int) -> float:
    """The quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, probability))


def pairs_needed(deviation: float, margin: float) -> int | None:
    """Pairs from which on the 90 % interval of a mean is at most the margin to either side.

    Args:
        deviation: Standard deviation of the pairs' differences.
        margin: The margin, above 0.

    Returns:
        The number; None where it is above 1,000.
    """
    for pairs in range(2, MOST_PAIRS + 1):
        if quantile(0.95, pairs - 1) * deviation / sqrt(pairs) <= margin:
            return pairs
    return None
