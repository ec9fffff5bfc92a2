"""Heights of cameras along the scene's upward axis."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene, UserError, View, centers_of, without_rounding

#: An axis, or the name of a method to find the axis.
Up: TypeAlias = Literal["auto", "cameras", "pca"] | tuple[float, float, float]

#: If the mean of the cameras' unit up axes is shorter than this, the axes point in all directions,
#: and the mean is not used.
_SHORTEST_MEAN = 0.1


def altitudes(scene: Scene, views: Sequence[View], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [V] the height of each camera above the mean training camera, along `up` [3].

    Rounding differences between equal heights are removed, as `radial_distances` does for
    distances.
    """
    # Do not use a matrix product, because its rounding depends on the number of rows. A median
    # threshold equals one of the heights, so a rounding error could move a camera to the other
    # group.
    return without_rounding(scene, ((centers_of(views) - scene.middle) * up).sum(axis=1))


def upward(scene: Scene, up: Up = "auto") -> tuple[NDArray[np.float64], str]:
    """Return the scene's unit upward axis [3] in the local frame, and a text about its origin.

    Method `cameras` uses the mean of the training cameras' up axes (-y of OpenCV cameras). Method
    `pca` uses the axis along which the camera centres vary least. Method `auto` uses `cameras`,
    unless the up axes cancel, as for cameras that look straight down in all headings.

    Raises:
        UserError: The given axis has no direction, or the cameras' up axes cancel.
    """
    if not isinstance(up, str):
        return _given(up), "given"
    mean = -np.stack([view.camera.world_to_camera[1, :3].numpy() for view in scene.train_views])
    axis = mean.astype(np.float64).mean(axis=0)
    length = float(np.linalg.norm(axis))
    if up == "pca" or (up == "auto" and length < _SHORTEST_MEAN):
        return _flattest(scene), "axis of least variance of the camera positions"
    if length < _SHORTEST_MEAN:
        raise UserError(
            "the upward direction cannot be computed: the up axes of the cameras cancel out",
            where="up",
            expected="most cameras held upright",
            todo="set `up` to pca or to an axis such as [0, 0, 1]",
        )
    return axis / length, "mean of the cameras' up axes"


def _given(up: tuple[float, float, float]) -> NDArray[np.float64]:
    axis = np.array(up, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length == 0.0:
        raise UserError(
            "the upward axis is not a valid direction",
            where="up",
            expected="three finite numbers, not all of them zero",
            found=str(list(up)),
            todo="give the axis as three numbers, such as [0, 0, 1], or use auto",
        )
    return axis / length


def _flattest(scene: Scene) -> NDArray[np.float64]:
    """Return the axis along which the training cameras' centres vary least.

    The sign is chosen so that the cameras are above the SfM points. Without SfM points, the sign is
    chosen so that the cameras look down.
    """
    spread = scene.robust_centers - scene.middle
    axis = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    if len(scene.points):
        downward = np.median(scene.points, axis=0) - scene.middle
    else:
        rows = [view.camera.world_to_camera[2, :3].numpy() for view in scene.train_views]
        downward = np.stack(rows).astype(np.float64).mean(axis=0)
    return np.asarray(-axis if float(axis @ downward) > 0.0 else axis)
