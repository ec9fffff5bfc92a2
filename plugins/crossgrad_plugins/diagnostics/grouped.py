"""Two groups of cameras: Gramian, variance within and between groups, ratio of gradient lengths."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError

#: Minimum number of views per group for an unbiased estimate of a variance.
SMALLEST_GROUP = 2


@dataclass(frozen=True, eq=False)
class Groups:
    """The group of each probed view, and the cameras from which the views were drawn.

    Attributes:
        near: [V] bool, True for views of the near group; all other views are far.
        cameras: Number of (near, far) cameras from which the views were drawn without replacement;
            None for independent draws from an unlimited set.
        shares: Weights (near, far) of the groups, summing to 1. Equal weights describe the
            objective of a balanced pair. Weights proportional to the group sizes describe the mean
            over all cameras.
    """

    near: NDArray[np.bool_]
    cameras: tuple[int, int] | None = None
    shares: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if min(self.sizes) < SMALLEST_GROUP:
            raise UserError(
                "the variance cannot be estimated: each group needs two views",
                where="diagnostics",
                found=f"{self.sizes[0]} near and {self.sizes[1]} far views",
                todo="probe more views, or choose another grouping",
            )

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """Number of probed views in (near, far)."""
        near = int(np.count_nonzero(self.near))
        return near, len(self.near) - near

    @cached_property
    def unseen(self) -> tuple[float, float]:
        """1 - n/N of each group: the share of its N cameras that were not probed.

        1 if N is unknown.
        """
        if self.cameras is None:
            return 1.0, 1.0
        near, far = (
            1.0 - size / total for size, total in zip(self.sizes, self.cameras, strict=True)
        )
        return near, far

    @cached_property
    def divisors(self) -> tuple[float, float]:
        """(N-1)/N of each group: the factor from sample variance to the variance of its N cameras.

        The factor is 1 if N is unknown.
        """
        if self.cameras is None:
            return 1.0, 1.0
        near, far = self.cameras
        return 1.0 - 1.0 / near, 1.0 - 1.0 / far


@dataclass(frozen=True, eq=False)
class GroupedGramian:
    """The Gramian of a block, split into group means and deviations, near views first.

    All values are divided by `scale`, so that no value can overflow.

    Attributes:
        scale: Mean squared length of the gradients: the mean of the Gramian's diagonal.
        near: [n, n] dot products of the near views' deviations from the near mean.
        far: [m, m] dot products of the far views' deviations from the far mean.
        cross: [n, m] dot products of near deviations with far deviations.
        gap: Squared distance of the two sample means.
        near_along: [n] dot products of near deviations with (near mean - far mean), centred; the
            view itself is left out of its group's mean.
        far_along: [m] dot products of far deviations with (near mean - far mean), in the same form.
    """

    scale: float
    near: NDArray[np.float64]
    far: NDArray[np.float64]
    cross: NDArray[np.float64]
    gap: float
    near_along: NDArray[np.float64]
    far_along: NDArray[np.float64]

    @classmethod
    def of(cls, gramian: NDArray[np.float64], groups: Groups) -> Self:
        """Split the Gramian [V, V] of one block."""
        n, m = groups.sizes
        order = np.argsort(~groups.near, kind="stable")
        scale = float(np.trace(gramian)) / len(gramian)
        ordered = gramian[np.ix_(order, order)] / (scale if scale > 0.0 else 1.0)
        averaging = np.zeros_like(ordered)
        averaging[:n, :n], averaging[n:, n:] = 1.0 / n, 1.0 / m
        centring = np.eye(n + m) - averaging
        deviations = centring @ ordered @ centring
        difference = np.concatenate([np.full(n, 1.0 / n), np.full(m, -1.0 / m)])
        # Leave the view out of the mean of its group. If the view were included, the length of its
        # gradient would correlate with its position along the difference of the means.
        self_terms = np.diag(deviations) / np.concatenate(
            [np.full(n, n - 1.0), np.full(m, 1.0 - m)]
        )
        along = centring @ (ordered @ difference - self_terms)
        return cls(
            scale=scale,
            near=deviations[:n, :n],
            far=deviations[n:, n:],
            cross=deviations[:n, n:],
            gap=max(float(difference @ ordered @ difference), 0.0),
            near_along=along[:n],
            far_along=along[n:],
        )


@dataclass(frozen=True)
class GradientRatio:
    """Ratio of gradient lengths, near over far; NaN if the far gradients are zero.

    Attributes:
        of_means: Mean length over near views, divided by the mean length over far views (the
            paper's R).
        median: Median ratio of lengths over pairs of a near and a far view, without pairs that
            contain a zero gradient.
    """

    of_means: float
    median: float


def gradient_ratio(squared: NDArray[np.float64], near: NDArray[np.bool_]) -> GradientRatio:
    """Return the ratio of gradient lengths for one block.

    Args:
        squared: [V] squared gradient lengths. They are the diagonal of the block's Gramian, or the
            sum of several diagonals for several concatenated blocks.
        near: [V] bool, True for views of the near group; all other views are far.
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
    """Return the geometric mean of ratios of blocks; NaN if a ratio is not positive."""
    if not all(ratio > 0.0 for ratio in ratios):
        return float("nan")
    return float(np.exp(np.mean(np.log(ratios))))


@dataclass(frozen=True)
class VarianceSplit:
    """Unbiased estimates of the paper's two variances.

    The estimate `between` may be negative.

    Attributes:
        within: sigma_w^2, the weighted mean over groups of E||g - group mean||^2, with gradient g.
        between: sigma_b^2, the product of the two group weights times ||near mean - far mean||^2.
    """

    within: float
    between: float

    @property
    def ratio(self) -> float:
        """sigma_b^2 / sigma_w^2; NaN if there is no variance within groups."""
        return self.between / self.within if self.within > 0.0 else float("nan")


def variance_split(gramian: NDArray[np.float64], groups: Groups) -> VarianceSplit:
    """Estimate sigma_w^2 and sigma_b^2 from the Gramian [V, V] of one block.

    The plain squared distance of the means is too large by the noise of the means, so this noise is
    subtracted. With one view per group, the noise could not be estimated. Both values are linear in
    the Gramian, so the values of several probes of the same views can be added.

    Source: the paper, Proposition 2; unbiased estimators of the variance of a mean. If the views
    were drawn without replacement, the correction for a finite population is applied.
    """
    parts = GroupedGramian.of(gramian, groups)
    within, between = split_of(parts, groups)
    return VarianceSplit(parts.scale * within, parts.scale * between)


def split_of(parts: GroupedGramian, groups: Groups) -> tuple[float, float]:
    """Return (sigma_w^2, sigma_b^2) in units of `parts.scale`."""
    (n, m), (p, q) = groups.sizes, groups.shares
    spread_near = float(np.trace(parts.near)) / (n - 1)
    spread_far = float(np.trace(parts.far)) / (m - 1)
    within = p * spread_near * groups.divisors[0] + q * spread_far * groups.divisors[1]
    noise = spread_near * groups.unseen[0] / n + spread_far * groups.unseen[1] / m
    return within, p * q * (parts.gap - noise)
