"""How large the scene appears: pixels per local unit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    Quantity,
    Rule,
    Scene,
    UserError,
    View,
    footprint_of,
)
from crossgrad_plugins.groupings.split import (
    FAR,
    NEAR,
    halves,
    require_groups,
    require_training_views,
)


class Footprint(Grouping):
    """near: views that draw a local unit over at least the median number of pixels; far: the rest.

    The measure of a view is the median of f/z over the SfM points that it observed, or over those
    in its image where it observed none. It uses the focal length and needs no layout of cameras
    around a centre.

    Source: the paper, projected footprint; the fall-back is ours.
    """

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> Rule:
        require_training_views(scene, "footprint")
        train = _footprints(scene, scene.train_views)
        threshold = float(np.median(train))
        # halves() calls small values near: a large footprint is a near camera.
        train_labels = halves(-train, -threshold)
        require_groups("footprint", train_labels, (NEAR, FAR), "projected footprint")
        note = f"grouping footprint: near from {threshold:.4g} pixels per local unit"
        return Rule(lambda views: halves(-_footprints(scene, views), -threshold), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        footprints = np.array([footprint_of(scene, view) for view in views])
        return Quantity("the log depth over focal length", -np.log(footprints))


def _footprints(scene: Scene, views: Sequence[View]) -> NDArray[np.float64]:
    """[V] footprints.

    Raises:
        UserError: A view has no SfM point in its image.
    """
    footprints = np.array([footprint_of(scene, view) for view in views])
    for view, footprint in zip(views, footprints, strict=True):
        if np.isnan(footprint):
            raise UserError(
                "grouping footprint needs SfM points in every view",
                where=view.name,
                found="no SfM point in this image",
                todo="choose grouping radial, which needs camera positions only",
            )
    return footprints
