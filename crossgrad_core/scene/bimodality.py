"""Sarle's bimodality coefficient, which tells whether values form one or two clusters."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: The bimodality coefficient of a uniform distribution (5/9), rounded down. A sample with a smaller
#: coefficient counts as a single cluster.
ONE_MODE: Final = 0.555
#: Smallest sample size for which the finite-sample kurtosis is defined.
_SMALLEST = 4
#: Smallest sample size for which the finite-sample form is used. In smaller samples, even two
#: separate values give a coefficient below the value of a uniform distribution (docs/groupings.md).
_SMALLEST_SAMPLE = 10


@dataclass(frozen=True)
class Bimodality:
    """Sarle's bimodality coefficient of a sample, in two forms.

    Typical values are 1/3 for a normal distribution, 5/9 for a uniform distribution, and 1 for a
    distribution on two points. A skewed distribution with a single mode can also reach 5/9, for
    example the exponential distribution. The finite-sample form is always below 1. Two equally
    frequent values give 0.566 for n = 10 and 0.951 for n = 100. A report of the coefficient must
    therefore include the sample size n.

    Attributes:
        sample: Finite-sample form with Fisher's skewness G1 and kurtosis G2; NaN if undefined.
        population: Form with the moments of the sample, (g1^2 + 1) / (g2 + 3) for skewness g1 and
            excess kurtosis g2; NaN if undefined.
        size: Sample size n.
        reason: Why a form is NaN; empty if both forms are defined.
    """

    sample: float
    population: float
    size: int
    reason: str = ""

    @property
    def deciding(self) -> float:
        """The form that decisions use: `sample`, but `population` for small samples."""
        return self.sample if self.size >= _SMALLEST_SAMPLE else self.population


def bimodality(values: NDArray[np.float64]) -> Bimodality:
    """Return Sarle's bimodality coefficient of the values [n], in both forms.

    Source: SAS/STAT user's guide, CLUSTER procedure (Sarle); Pfister et al. 2013.
    """
    size = len(values)
    if size < _SMALLEST:
        reason = f"{size} values, but the coefficient needs at least {_SMALLEST}"
        return Bimodality(float("nan"), float("nan"), size, reason)
    deviations = values - values.mean()
    spread = float(np.abs(deviations).max())
    # Rounding of the mean can make deviations non-zero even if all values are equal.
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
