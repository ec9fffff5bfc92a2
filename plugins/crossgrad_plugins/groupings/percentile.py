"""A radial split at another percentile than the median."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    Quantity,
    Rule,
    Scene,
    View,
    radial_distances,
)
from crossgrad_plugins.groupings.split import (
    FAR,
    NEAR,
    halves,
    log_distances,
    require_groups,
    require_training_views,
)


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
    ) -> Rule:
        require_training_views(scene, "percentile")
        train = radial_distances(scene, scene.train_views)
        threshold = float(np.percentile(train, self.q))
        quantity = "distance from their mean"
        require_groups("percentile", halves(train, threshold), (NEAR, FAR), quantity)
        note = f"grouping percentile: near up to {threshold:.4g} local units from the mean camera"
        return Rule(lambda views: halves(radial_distances(scene, views), threshold), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)
