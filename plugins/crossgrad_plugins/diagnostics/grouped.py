"""A Gramian of gradients from two groups of cameras."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError

#: Views per group that an unbiased estimate of a variance needs.
SMALLEST_GROUP = 2


@dataclass(frozen=True, eq=False)
class Groups:
    """Which views of a probe belong to which group, and what they stand for.

    Attributes:
        near: [V] bool, the views of the near group; the others are far.
        cameras: Sizes (near, far) of the population that the views were drawn from without
            replacement; None where they stand for cameras in general (independent draws).
        shares: Weights (near, far) of the groups, summing to 1. Equal ones describe the objective
            of a balanced pair; the sizes' shares describe the mean over cameras.
    """

    near: NDArray[np.bool_]
    cameras: tuple[int, int] | None = None
    shares: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if min(self.sizes) < SMALLEST_GROUP:
            raise UserError(
                "a variance needs two views of each group",
                where="diagnostics",
                found=f"{self.sizes[0]} near and {self.sizes[1]} far views",
                todo="probe more views, or choose another grouping",
            )

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """Number of (near, far) views in the probe."""
        near = int(np.count_nonzero(self.near))
        return near, len(self.near) - near

    @cached_property
    def unseen(self) -> tuple[float, float]:
        """1 - n/N of either group, the share of its cameras that was not probed; 1 if endless."""
        if self.cameras is None:
            return 1.0, 1.0
        near, far = (
            1.0 - size / total for size, total in zip(self.sizes, self.cameras, strict=True)
        )
        return near, far

    @cached_property
    def divisors(self) -> tuple[float, float]:
        """(N-1)/N of either group: from sample variances to the population's own; 1 if endless."""
        if self.cameras is None:
            return 1.0, 1.0
        near, far = self.cameras
        return 1.0 - 1.0 / near, 1.0 - 1.0 / far


@dataclass(frozen=True, eq=False)
class GroupedGramian:
    """The Gramian of one block, near views first, split into means and deviations.

    All figures are relative to `scale`, the mean squared norm, so that none can overflow.

    Attributes:
        scale: Mean of the Gramian's diagonal.
        near: [n, n] dot products of deviations from the near mean.
        far: [m, m] likewise for the far group.
        cross: [n, m] dot products of near with far deviations.
        gap: Squared distance of the two sample means.
        near_along: [n] dot products of near deviations with (near mean - far mean), each without
            the view's own part in its group's mean; centred.
        far_along: [m] likewise for the far group.
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
        """From the Gramian [V, V] of one block."""
        n, m = groups.sizes
        order = np.argsort(~groups.near, kind="stable")
        scale = float(np.trace(gramian)) / len(gramian)
        ordered = gramian[np.ix_(order, order)] / (scale if scale > 0.0 else 1.0)
        averaging = np.zeros_like(ordered)
        averaging[:n, :n], averaging[n:, n:] = 1.0 / n, 1.0 / m
        centring = np.eye(n + m) - averaging
        deviations = centring @ ordered @ centring
        difference = np.concatenate([np.full(n, 1.0 / n), np.full(m, -1.0 / m)])
        # A view's own part in the mean would correlate its length with its place along the gap.
        own = np.diag(deviations) / np.concatenate([np.full(n, n - 1.0), np.full(m, 1.0 - m)])
        along = centring @ (ordered @ difference - own)
        return cls(
            scale=scale,
            near=deviations[:n, :n],
            far=deviations[n:, n:],
            cross=deviations[:n, n:],
            gap=max(float(difference @ ordered @ difference), 0.0),
            near_along=along[:n],
            far_along=along[n:],
        )
