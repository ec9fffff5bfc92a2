"""How large the scene appears: pixels per local unit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.errors import UserError
from crossgrad_core.grouping import GradientProbe, Grouping, Labelling
from crossgrad_core.scene.types import Camera, Scene, View
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
    def label(
        self,
        scene: Scene,
        views: Sequence[View],
        rng: np.random.Generator,
        probe: GradientProbe | None = None,
    ) -> Labelling:
        require_training_views(scene, "footprint")
        train = np.array([footprint_of(scene, view) for view in scene.train_views])
        threshold = float(np.median(train))
        # halves() calls small values near: a large footprint is a near camera.
        train_labels = halves(-train, -threshold)
        require_groups("footprint", train_labels, (NEAR, FAR), "projected footprint")
        values = np.array([footprint_of(scene, view) for view in views])
        note = f"grouping footprint: near from {threshold:.4g} pixels per local unit"
        return Labelling(halves(-values, -threshold), (note,))


def footprint_of(scene: Scene, view: View) -> float:
    """Median of f/z [pixels per local unit] over the SfM points in front of a view.

    Raises:
        UserError: No SfM point lies in the view's image.
    """
    depths = _depths(view.camera, scene.points[view.seen])
    if len(depths) == 0:
        depths = _depths(view.camera, scene.points, inside=True)
    if len(depths) == 0:
        raise UserError(
            "grouping footprint needs SfM points in every view",
            where=view.name,
            found="no SfM point in this image",
            todo="choose grouping radial, which needs camera positions only",
        )
    return float(np.sqrt(view.camera.fx * view.camera.fy) / np.median(depths))


def _depths(
    camera: Camera, points: NDArray[np.float64], *, inside: bool = False
) -> NDArray[np.float64]:
    """Depths of the points [P, 3] in front of the camera; with `inside`, in its image only."""
    pose = camera.world_to_camera.numpy()
    local = points @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > 0.0]
    if inside:
        x = camera.fx * local[:, 0] / local[:, 2] + camera.cx
        y = camera.fy * local[:, 1] / local[:, 2] + camera.cy
        local = local[(x >= 0.0) & (x <= camera.width) & (y >= 0.0) & (y <= camera.height)]
    return np.asarray(local[:, 2])
