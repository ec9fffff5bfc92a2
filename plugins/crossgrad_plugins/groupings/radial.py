"""The paper's default split: distance from the mean camera, at its median."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GradientProbe, Grouping, GroupingRule, Quantity, Scene, View
from crossgrad_plugins.groupings.split import CUT, Cut, cut_of, log_distances, rule_of_distances


class Radial(Grouping):
    """near where the distance from the mean training camera is at most its median, else far.

    Source: the paper, median radial split; Otsu's cut is ours.
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
