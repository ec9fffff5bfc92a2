"""A radial split at another percentile than the median."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GradientProbe, Grouping, GroupingRule, Quantity, Scene, View
from crossgrad_plugins.groupings.split import log_distances, rule_of_distances


class Percentile(Grouping):
    """near where the distance from the mean training camera is at most its q-th percentile.

    Balanced pairs then estimate (near mean + far mean) / 2, not the mean over cameras: for q away
    from 50 that is another objective, not only another variance.

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
