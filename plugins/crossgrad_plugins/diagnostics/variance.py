"""Gradient variance within and between two groups of cameras."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import GroupedGramian, Groups


@dataclass(frozen=True)
class VarianceSplit:
    """Unbiased estimates of the paper's variances; `between` may come out negative.

    Attributes:
        within: sigma_w^2, weighted mean over groups of E||g - group mean||^2.
        between: sigma_b^2, product of the shares times ||near mean - far mean||^2.
    """

    within: float
    between: float

    @property
    def ratio(self) -> float:
        """sigma_b^2 / sigma_w^2; NaN where there is no variance within groups."""
        return self.between / self.within if self.within > 0.0 else float("nan")


def variance_split(gramian: NDArray[np.float64], groups: Groups) -> VarianceSplit:
    """sigma_w^2 and sigma_b^2 from the Gramian [V, V] of one block.

    The plain ||difference of means||^2 overestimates sigma_b^2 by the means' own noise, which is
    taken off here; with one view per group nothing would be left but noise. Both figures are linear
    in the Gramian: those of a sum over probes of the same views are the sums.

    Source: the paper, Proposition 2; unbiased estimators of the variance of a mean, with the finite
    population's correction where the views were drawn without replacement.
    """
    parts = GroupedGramian.of(gramian, groups)
    within, between = split_of(parts, groups)
    return VarianceSplit(parts.scale * within, parts.scale * between)


def split_of(parts: GroupedGramian, groups: Groups) -> tuple[float, float]:
    """(sigma_w^2, sigma_b^2) in units of `parts.scale`."""
    (n, m), (p, q) = groups.sizes, groups.shares
    spread_near = float(np.trace(parts.near)) / (n - 1)
    spread_far = float(np.trace(parts.far)) / (m - 1)
    within = p * spread_near * groups.divisors[0] + q * spread_far * groups.divisors[1]
    noise = spread_near * groups.unseen[0] / n + spread_far * groups.unseen[1] / m
    return within, p * q * (parts.gap - noise)
