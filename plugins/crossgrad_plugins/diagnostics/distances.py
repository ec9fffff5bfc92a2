"""The relation between the gradient conflict of two views and the difference of their distances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

#: Two correlations count as equal if they differ by less than this value.
_ROUNDING = 1e-9
#: Number of decimals to which differences of logarithms are rounded. Further decimals contain only
#: rounding errors.
_DIGITS = 9
#: Number of bins of photo pairs. Pairs are sorted into bins by the difference of the two views'
#: distances.
_BINS = 4


@dataclass(frozen=True, eq=False)
class DistanceConflict:
    """The relation between conflict of two views and the difference of their distances.

    Attributes:
        rates: [4] share of conflicting pairs in each quarter of |log r_i - log r_j|, with camera
            distances r; NaN for an empty quarter.
        correlation: Rank correlation (Spearman) of conflict with |log r_i - log r_j| over all
            pairs; NaN if one of them is constant.
        p_value: Share of camera permutations (Mantel's test) that give a correlation at least as
            large.
    """

    rates: NDArray[np.float64]
    correlation: float
    p_value: float


def conflict_by_distance(
    gramian: NDArray[np.float64],
    distances: NDArray[np.float64],
    rng: np.random.Generator,
    *,
    permutations: int = 499,
) -> DistanceConflict:
    """Measure Observation 1 of the paper within one scene, for one parameter block.

    Every pair of views whose gradients have a non-zero dot product counts. Different pairs contain
    the same cameras, so the test permutes cameras and not pairs.

    Args:
        gramian: [V, V] dot products of the views' gradients.
        distances: [V] camera distances, any unit.
        rng: Generator of the permutations.
        permutations: Number of permutations.
    """
    positive = np.flatnonzero(distances > 0.0)
    logs, products = np.log(distances[positive]), gramian[np.ix_(positive, positive)]
    first, second = np.triu_indices(len(positive), 1)
    counted = products[first, second] != 0.0
    if not counted.any():
        return DistanceConflict(np.full(_BINS, np.nan), np.nan, np.nan)
    ranks = _pair_ranks(logs)
    first, second = first[counted], second[counted]
    apart = _apart(logs, first, second)
    negative = products[first, second] < 0.0
    edges = np.quantile(apart, np.linspace(0.0, 1.0, _BINS + 1))
    # The first order is the data's own order. The other orders are random permutations.
    orders = [
        np.arange(len(positive)),
        *(rng.permutation(len(positive)) for _ in range(permutations)),
    ]
    order = np.stack(orders)
    correlations = _correlations(ranks[order[:, first], order[:, second]], negative)
    # Equal correlations may differ by rounding errors, because their sums are computed in different
    # orders.
    above = int((correlations[1:] >= correlations[0] - _ROUNDING).sum())
    p_value = (1 + above) / (1 + permutations) if np.isfinite(correlations[0]) else np.nan
    rates = _rates(apart, negative, edges)
    return DistanceConflict(rates, float(correlations[0]), p_value)


def relative_variance(distances: NDArray[np.float64]) -> float:
    """Return Var(r) / mean(r)^2 of distances [V]; NaN without distances or if all are 0."""
    return float(distances.var() / distances.mean() ** 2) if distances.any() else float("nan")


def _rates(
    apart: NDArray[np.float64], negative: NDArray[np.bool_], edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return [Q] the share of negative pairs in each bin between edges [Q + 1]; NaN if empty."""
    bins = len(edges) - 1
    places = np.clip(np.searchsorted(edges, apart, side="right") - 1, 0, bins - 1)
    inside = [negative[places == bin_index] for bin_index in range(bins)]
    return np.array([float(pairs.mean()) if len(pairs) else np.nan for pairs in inside])


def _pair_ranks(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [V, V] the rank of |log r_i - log r_j| among all pairs."""
    first, second = np.triu_indices(len(logs), 1)
    ranks = np.zeros((len(logs), len(logs)))
    ranks[first, second] = rankdata(_apart(logs, first, second))
    return ranks + ranks.T


def _apart(
    logs: NDArray[np.float64], first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return |log r_i - log r_j| of pairs.

    The values are rounded so that equal distances give equal values.
    """
    return np.asarray(np.abs(logs[first] - logs[second]).round(_DIGITS))


def _correlations(ranks: NDArray[np.float64], negative: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return [R] correlations of ranks [R, pairs] with conflict; NaN if ranks are constant."""
    about = ranks - ranks.mean(axis=1, keepdims=True)
    conflict = negative - negative.mean()
    lengths = np.sqrt((about**2).sum(axis=1) * (conflict @ conflict))
    undefined = np.full(len(ranks), np.nan)
    return np.asarray(
        np.divide(about @ conflict, lengths, out=undefined, where=lengths > 0.0), dtype=np.float64
    )
