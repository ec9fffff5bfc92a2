"""Conflict of views against how much their distances differ."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata


@dataclass(frozen=True, eq=False)
class DistanceConflict:
    """Conflict of pairs of views against how far apart their distances are.

    Attributes:
        variance: Variance of the distances over their squared mean.
        edges: [Q + 1] edges of |log r_i - log r_j|, quantiles over pairs.
        rates: [Q] conflict rate of the pairs of each bin; NaN in an empty one.
        correlation: Spearman's rank correlation of conflict with |log r_i - log r_j|; NaN where
            either is constant.
        p_value: Share of relabelled cameras (Mantel's permutations) with as large a correlation.
    """

    variance: float
    edges: NDArray[np.float64]
    rates: NDArray[np.float64]
    correlation: float
    p_value: float


def conflict_by_distance(
    gramian: NDArray[np.float64],
    distances: NDArray[np.float64],
    rng: np.random.Generator,
    *,
    bins: int = 4,
    permutations: int = 499,
) -> DistanceConflict:
    """The paper's Observation 1 within one scene, for one block.

    Every pair of views with a dot product other than zero counts. Pairs share cameras, so their
    correlation is judged by permuting cameras, not pairs.

    Args:
        gramian: [V, V].
        distances: [V] camera distances, any unit.
        rng: For the permutations.
        bins: Q.
        permutations: How many.
    """
    variance = float(distances.var() / distances.mean() ** 2) if distances.any() else float("nan")
    positive = np.flatnonzero(distances > 0.0)
    logs, products = np.log(distances[positive]), gramian[np.ix_(positive, positive)]
    first, second = np.triu_indices(len(positive), 1)
    counted = products[first, second] != 0.0
    first, second = first[counted], second[counted]
    if len(first) == 0:
        nothing = np.full(bins, np.nan)
        return DistanceConflict(variance, np.full(bins + 1, np.nan), nothing, np.nan, np.nan)
    apart = np.abs(logs[first] - logs[second])
    negative = (products[first, second] < 0.0).astype(np.float64)
    edges = np.quantile(apart, np.linspace(0.0, 1.0, bins + 1))
    places = np.clip(np.searchsorted(edges, apart, side="right") - 1, 0, bins - 1)
    rates = [float(negative[places == b].mean()) if (places == b).any() else np.nan
             for b in range(bins)]  # fmt: skip
    correlation = _rank_correlation(apart, negative)
    orders = (rng.permutation(len(positive)) for _ in range(permutations))
    relabelled = [np.abs(logs[order[first]] - logs[order[second]]) for order in orders]
    above = sum(_rank_correlation(other, negative) >= correlation for other in relabelled)
    p_value = (1 + above) / (1 + permutations) if np.isfinite(correlation) else np.nan
    return DistanceConflict(variance, edges, np.array(rates), correlation, p_value)


def _rank_correlation(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    a, b = rankdata(x), rankdata(y)
    a, b = a - a.mean(), b - b.mean()
    length = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / length if length > 0.0 else float("nan")
