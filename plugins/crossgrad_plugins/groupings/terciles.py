"""Thirds of the distance from the mean camera."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import GradientProbe, Grouping, GroupingRule, Quantity, Scene, View
from crossgrad_plugins.groupings.split import FAR, MIDDLE, NEAR, log_distances
from crossgrad_plugins.groupings.thirds import rule_by_shares


class Terciles(Grouping):
    """near, middle and far: the thirds of the distance from the mean training camera.

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
