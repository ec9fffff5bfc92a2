"""Groups of cameras by the size of the scene in the image, in pixels per local unit."""

from collections.abc import Sequence

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
    UserError,
    View,
    centers_of,
    footprint_of,
)
from crossgrad_plugins.groupings.split import (
    CUT,
    FAR,
    NEAR,
    Cut,
    cut_of,
    halves,
    require_groups,
    require_training_views,
)


class Footprint(Grouping):
    """near: views that show a local unit with at least the median number of pixels.

    All other views are far. The footprint of a view is the median of f/z over the SfM points that
    the view observed; f is the focal length and z is the depth. If the view observed fewer than
    three points, all SfM points inside its image are used. If the image contains no points either,
    the view gets the footprint of the nearest training camera that has one. The footprint depends
    on the focal length, and does not assume that the cameras surround a centre.

    Source: the paper, projected footprint; Otsu's threshold and the fallbacks were added for
    crossgrad.
    """

    cut: Cut = Field("median", description=CUT)

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "footprint")
        footprints = _own(scene, scene.train_views)
        blind = np.isnan(footprints)
        if blind.all():
            raise UserError(
                "grouping footprint needs SfM points that are visible in photos",
                where=scene.name,
                found="no SfM point is visible in a training photo",
                todo="choose grouping radial, which needs only camera positions",
            )
        known_footprints, places = footprints[~blind], scene.centers[~blind]

        def sizes(views: Sequence[View]) -> NDArray[np.float64]:
            """Return [V] negative footprints, because `halves` assigns small values to near."""
            return -_filled(_own(scene, views), views, known_footprints, places)

        train = sizes(scene.train_views)
        threshold = -cut_of(-train, self.cut)
        require_groups("footprint", halves(train, threshold), (NEAR, FAR), "projected footprint")
        note = f"grouping footprint: near from {-threshold:.4g} pixels per local unit"
        if blind.any():
            note += (
                "; training views without SfM points join the group of the nearest other "
                f"view: {blind.sum()}"
            )
        return GroupingRule(lambda views: halves(sizes(views), threshold), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return Quantity("the log depth over focal length", -np.log(_own(scene, views)))


def _own(scene: Scene, views: Sequence[View]) -> NDArray[np.float64]:
    """Return [V] footprints; NaN if a view shows no SfM point."""
    return np.array([footprint_of(scene, view) for view in views])


def _filled(
    footprints: NDArray[np.float64],
    views: Sequence[View],
    known_footprints: NDArray[np.float64],
    places: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return [V] footprints.

    NaN becomes the value of the nearest camera, with centres `places` [N, 3].
    """
    for row, view in enumerate(views):
        if np.isnan(footprints[row]):
            ways = np.linalg.norm(places - centers_of((view,)), axis=1)
            footprints[row] = known_footprints[ways.argmin()]
    return footprints
