"""Anchors: the nearest and the farthest cameras, and the rest between them."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GradientProbe, Grouping, GroupingRule, Quantity, Scene, View
from crossgrad_plugins.groupings.split import FAR, MIDDLE, NEAR, log_distances
from crossgrad_plugins.groupings.thirds import rule_by_shares


class Anchors(Grouping):
    """near: the nearest 30 % of the training cameras; far: the farthest 30 %; middle: the others.

    The middle may be empty in a scene of very few cameras; near and far may not.

    Source: the paper, operator variants.
    """

    labels: ClassVar[tuple[str, ...]] = (NEAR, MIDDLE, FAR)

    share: float = Field(0.3, gt=0.0, le=0.5, description="share of the cameras on either side")

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        return rule_by_shares(scene, "anchors", self.share, (NEAR, FAR))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)
