"""The grouping slot: labels of views, for sampling."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from crossgrad_core.component import Component
from crossgrad_core.scene.types import Scene, View


class Grouping(Component):
    """Labels views; the rule is fitted on the training cameras and then applied to all.

    Attributes:
        labels: Every label the rule can give, near first.
    """

    slot: ClassVar[str] = "groupings"
    labels: ClassVar[tuple[str, ...]] = ("near", "far")

    @abstractmethod
    def label(
        self, scene: Scene, views: Sequence[View], rng: np.random.Generator
    ) -> tuple[str, ...]:
        """One label per view of `views`, by the rule fitted on `scene.train_views`.

        Raises:
            UserError: The rule leaves a group empty, with what to do.
        """
