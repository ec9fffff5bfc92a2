"""How much longer the gradients of near views are than those of far views."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class GradientRatio:
    """Ratio of gradient lengths, near over far; NaN where the far gradients are zero.

    Attributes:
        of_means: Mean length over near views / mean length over far views (the paper's R).
        median: Median over pairs of one near and one far view of the ratio of their lengths, pairs
            with a zero gradient left out.
    """

    of_means: float
    median: float


def gradient_ratio(squared: NDArray[np.float64], near: NDArray[np.bool_]) -> GradientRatio:
    """The ratio of one block.

    Args:
        squared: [V] squared gradient lengths: the diagonal of the block's Gramian, or the sum of
            the diagonals of several blocks for their concatenation.
        near: [V], the views of the near group; the others are far.
    """
    lengths = np.sqrt(np.maximum(squared, 0.0))
    far_mean = float(lengths[~near].mean())
    of_means = float(lengths[near].mean()) / far_mean if far_mean > 0.0 else float("nan")
    logs = np.log(lengths[near & (lengths > 0.0)])[:, None]
    others = np.log(lengths[~near & (lengths > 0.0)])[None, :]
    pairs = logs - others
    median = float(np.exp(np.median(pairs))) if pairs.size else float("nan")
    return GradientRatio(of_means, median)


def geometric_mean(ratios: tuple[float, ...]) -> float:
    """Geometric mean of positive ratios, for blocks whose units differ; NaN where one is not."""
    if not all(ratio > 0.0 for ratio in ratios):
        return float("nan")
    return float(np.exp(np.mean(np.log(ratios))))
