"""The paper's default split: distance from the mean camera, at its median."""

from collections.abc import Sequence

import numpy as np
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


class Radial(Grouping):
    """near where the distance from the mean training camera is at most its median, else far.

    Source: the paper, median radial split.
    """

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> Rule:
        require_training_views(scene, "radial")
        train = radial_distances(scene, scene.train_views)
        threshold = float(np.median(train))
        require_groups("radial", halves(train, threshold), (NEAR, FAR), "distance from their mean")
        note = f"grouping radial: near up to {threshold:.4g} local units from the mean camera"
        return Rule(lambda views: halves(radial_distances(scene, views), threshold), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)
