"""Three groups by two thresholds on the distance from the mean camera."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import GroupingRule, Scene, radial_distances
from crossgrad_plugins.groupings.split import (
    FAR,
    MIDDLE,
    NEAR,
    require_groups,
    require_training_views,
)


def rule_by_shares(
    scene: Scene, grouping: str, share: float, needed: Sequence[str]
) -> GroupingRule:
    """Near up to quantile `share` of the radial distance, far beyond quantile 1 - share.

    Args:
        scene: The scene.
        grouping: Name of the grouping, for messages.
        share: Share of the training cameras on either side, at most 1/2.
        needed: Labels that need training views.

    Raises:
        UserError: A needed label has no training views.
    """
    require_training_views(scene, grouping)
    train = radial_distances(scene, scene.train_views)
    low, high = (float(bound) for bound in np.quantile(train, (share, 1.0 - share)))
    quantity = "distance from their mean"
    require_groups(grouping, _three(train, low, high), needed, quantity)
    note = f"grouping {grouping}: near up to {low:.4g}, far beyond {high:.4g} local units"
    return GroupingRule(lambda views: _three(radial_distances(scene, views), low, high), (note,))


def _three(values: NDArray[np.float64], low: float, high: float) -> tuple[str, ...]:
    return tuple(NEAR if r <= low else FAR if r > high else MIDDLE for r in values)
