"""Low and high cameras."""

from collections.abc import Sequence
from typing import Literal

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
)
from crossgrad_plugins.groupings.heights import altitudes, upward
from crossgrad_plugins.groupings.split import (
    FAR,
    NEAR,
    gap_threshold,
    halves,
    otsu_threshold,
    require_groups,
    require_training_views,
)


class Altitude(Grouping):
    """near: cameras up to a given height; far: cameras above it.

    Source: the paper, altitude thresholds; the axis and the threshold rule were chosen for
    crossgrad.
    """

    up: Literal["auto", "cameras", "pca"] | tuple[float, float, float] = Field(
        "auto",
        description="upward axis: x, y, z in the scene's frame; cameras: mean of the cameras' up "
        "axes; pca: axis of least variance of the positions; auto: cameras if their "
        "up axes agree, else pca",
    )
    cut: Literal["median", "otsu", "gap"] = Field(
        "median", description="threshold: median height, Otsu's threshold, or the widest gap"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "altitude")
        axis, source = upward(scene, self.up)
        train = altitudes(scene, scene.train_views, axis)
        threshold = self._threshold(train)
        require_groups("altitude", halves(train, threshold), (NEAR, FAR), "height")
        note = (
            f"grouping altitude: near up to {threshold:.4g} local units above the mean camera; "
            f"up is {np.array2string(axis, precision=3)} ({source})"
        )
        return GroupingRule(lambda views: halves(altitudes(scene, views, axis), threshold), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        axis, _ = upward(scene, self.up)
        return Quantity("the height", altitudes(scene, views, axis))

    def _threshold(self, heights: NDArray[np.float64]) -> float:
        if self.cut == "median":
            return float(np.median(heights))
        return otsu_threshold(heights) if self.cut == "otsu" else gap_threshold(heights)
