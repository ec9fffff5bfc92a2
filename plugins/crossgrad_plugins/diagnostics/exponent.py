"""Gradient length against camera distance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from crossgrad_plugins.diagnostics.intervals.interval import UNKNOWN, Interval

#: A line and the scatter around it.
_SMALLEST = 4


@dataclass(frozen=True)
class Exponent:
    """d_theta of ||gradient|| ~ r^-d_theta; positive where near views have longer gradients.

    Attributes:
        value: The fitted exponent; NaN where it is undefined.
        interval: Its confidence interval.
        views: Number of views with a non-zero gradient and distance.
    """

    value: float
    interval: Interval
    views: int


def distance_exponent(
    squared: NDArray[np.float64], distances: NDArray[np.float64], level: float = 0.95
) -> Exponent:
    """Least-squares line of log length over log distance; the interval allows for unequal scatter.

    Args:
        squared: [V] squared gradient lengths of one block.
        distances: [V] camera distances, any unit.
        level: Confidence level.

    Source: the paper, Proposition 1 (P1: larger for geometry than for amplitudes; P4: only where
    the distance matches the visual scale); HC3 standard error, MacKinnon and White 1985.
    """
    kept = (squared > 0.0) & (distances > 0.0)
    views = int(kept.sum())
    x, y = np.log(distances[kept]), np.log(squared[kept]) / 2.0
    if views < _SMALLEST or float(np.ptp(x)) == 0.0:
        return Exponent(float("nan"), UNKNOWN, views)
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    residuals = y - y.mean() - slope * centred
    leverage = np.minimum(1.0 / views + centred**2 / spread, 1.0 - 1e-9)
    error = float(np.sqrt(((centred * residuals / (1.0 - leverage)) ** 2).sum())) / spread
    reach = float(t.ppf((1.0 + level) / 2.0, views - 2)) * error
    return Exponent(-slope, Interval(-slope - reach, -slope + reach), views)
