"""Sarle's bimodality coefficient."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: The bimodality coefficient of a uniform sample, rounded down. Samples below this value have one
#: mode.
ONE_MODE: Final = 0.555
#: Smallest sample for which the finite-sample kurtosis is defined.
_SMALLEST = 4
#: Minimum sample size. In a smaller sample with values at only two points, the finite-sample
#: coefficient stays below the value of a uniform sample (docs/groupings.md).
_SMALLEST_SAMPLE = 10


@dataclass(frozen=True)
class Bimodality:
    """Sarle's coefficient of one sample.

    For orientation: the coefficient is 1/3 for a normal distribution, 5/9 for a uniform
    distribution, and 1 for any distribution on two points. Skewness alone reaches 5/9 (exponential
    distribution). The finite-sample form is always below 1: two equally populated points give 0.566
    at n = 10 and 0.951 at n = 100. Therefore, n must be reported with the coefficient.

    Attributes:
        sample: Finite-sample form with Fisher's G1 and G2; NaN if undefined.
        population: Form with plain moments, (g1^2 + 1) / (g2 + 3); NaN if undefined.
        size: n.
        reason: Why a form is NaN; empty if both forms are defined.
    """

    sample: float
    population: float
    size: int
    reason: str = ""

    @property
    def deciding(self) -> float:
        """The form used for decisions: finite-sample, or plain moments for small samples."""
        return self.sample if self.size >= _SMALLEST_SAMPLE else self.population


def bimodality(values: NDArray[np.float64]) -> Bimodality:
    """Compute Sarle's coefficient of the values [n] in both forms.

    Source: SAS/STAT user's guide, CLUSTER procedure (Sarle); Pfister et al. 2013.
    """
    size = len(values)
    if size < _SMALLEST:
        reason = f"{size} values, but the coefficient needs at least {_SMALLEST}"
        return Bimodality(float("nan"), float("nan"), size, reason)
    deviations = values - values.mean()
    spread = float(np.abs(deviations).max())
    # If all values are equal, the deviations can still be non-zero, because the mean is rounded.
    if spread <= 4.0 * np.finfo(np.float64).eps * float(np.abs(values).max()):
        return Bimodality(float("nan"), float("nan"), size, "all values are equal")
    scaled = deviations / spread
    m2, m3, m4 = (float((scaled**power).mean()) for power in (2, 3, 4))
    g1, g2 = m3 / m2**1.5, m4 / m2**2 - 3.0
    population = (g1**2 + 1.0) / (g2 + 3.0)
    return Bimodality(_finite_sample(g1, g2, size), population, size)


def _finite_sample(g1: float, g2: float, n: int) -> float:
    skewness = g1 * sqrt(n * (n - 1.0)) / (n - 2.0)
    kurtosis = (n - 1.0) * ((n + 1.0) * g2 + 6.0) / ((n - 2.0) * (n - 3.0))
    return (skewness**2 + 1.0) / (kurtosis + 3.0 * (n - 1.0) ** 2 / ((n - 2.0) * (n - 3.0)))
