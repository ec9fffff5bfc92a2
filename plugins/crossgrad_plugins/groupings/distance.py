"""Groups of cameras by their distance from the mean camera."""

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Quantity,
    Scene,
    View,
    radial_distances,
)
from crossgrad_plugins.groupings.split import (
    CUT,
    FAR,
    MIDDLE,
    NEAR,
    Cut,
    cut_of,
    log_distances,
    require_groups,
    require_training_views,
    rule_of_distances,
)


class Radial(Grouping):
    """near: cameras up to the median distance from the mean training camera; far: all others.

    Source: the paper, median radial split; Otsu's threshold was added for crossgrad.
    """

    cut: Cut = Field("median", description=CUT)

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        return rule_of_distances(scene, "radial", partial(cut_of, cut=self.cut))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)


class Percentile(Grouping):
    """near: cameras up to the q-th percentile of the distance from the mean camera.

    All other cameras are far. Balanced pairs then estimate (near mean + far mean) / 2 instead of
    the mean over all cameras. If q is not 50, these two means differ, so the run trains another
    objective.

    Source: the paper, partition threshold study (30 and 70).
    """

    q: float = Field(30.0, gt=0.0, lt=100.0, description="percentile of the distances")

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        return rule_of_distances(
            scene, "percentile", lambda distances: np.percentile(distances, self.q)
        )

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)


class Terciles(Grouping):
    """near, middle and far: thirds of the cameras by distance from the mean training camera.

    Source: the paper, 3-way groups.
    """

    labels: ClassVar[tuple[str, ...]] = (NEAR, MIDDLE, FAR)

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        return rule_by_shares(scene, "terciles", 1.0 / 3.0, self.labels)

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)


class Anchors(Grouping):
    """near: the nearest 30 % of the training cameras; far: the farthest 30 %; middle: all others.

    In a scene with very few cameras, middle may be empty; near and far may not be empty.

    Source: the paper, operator variants.
    """

    labels: ClassVar[tuple[str, ...]] = (NEAR, MIDDLE, FAR)

    share: float = Field(
        0.3, gt=0.0, le=0.5, description="share of the cameras in each of the two groups"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        return rule_by_shares(scene, "anchors", self.share, (NEAR, FAR))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)


def rule_by_shares(
    scene: Scene, grouping: str, share: float, needed: Sequence[str]
) -> GroupingRule:
    """Return the rule that puts equal shares of the cameras into near and far.

    near ends at the quantile `share` of the radial distance, and far starts at the quantile 1 -
    share.

    Args:
        scene: The scene.
        grouping: Name of the grouping, for messages.
        share: Share of the training cameras in near, and also in far; at most 1/2.
        needed: Labels that need training views.

    Raises:
        UserError: A needed label has no training views.
    """
    require_training_views(scene, grouping)
    train = radial_distances(scene, scene.train_views)
    low, high = (float(bound) for bound in np.quantile(train, (share, 1.0 - share)))
    quantity = "distance from their mean"
    require_groups(grouping, _three(train, low, high), needed, quantity)
    note = f"grouping {grouping}: near up to {low:.4g}, far above {high:.4g} local units"
    return GroupingRule(lambda views: _three(radial_distances(scene, views), low, high), (note,))


def _three(values: NDArray[np.float64], low: float, high: float) -> tuple[str, ...]:
    return tuple(NEAR if r <= low else FAR if r > high else MIDDLE for r in values)
