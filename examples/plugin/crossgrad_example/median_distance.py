"""A grouping into near and far by the median distance from the mean camera."""

from collections.abc import Sequence

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Scene,
    UserError,
    View,
    radial_distances,
)


class MedianDistance(Grouping):
    """Views whose camera is within the median distance of the mean camera are near, else far."""

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        threshold = float(np.median(radial_distances(scene, scene.train_views)))

        def labels(views: Sequence[View]) -> tuple[str, ...]:
            distances = radial_distances(scene, views)
            return tuple("near" if each <= threshold else "far" for each in distances)

        if len(set(labels(scene.train_views))) == 1:
            raise UserError("all training cameras are equally far from the scene", where="grouping")
        return GroupingRule(labels)
