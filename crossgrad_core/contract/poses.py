"""Where cameras are: centres, distances, heights, and how large the scene appears to them."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera, Scene, View, centers_of
from crossgrad_core.errors import UserError

#: An axis, or where to take it from.
Up: TypeAlias = Literal["auto", "cameras", "pca"] | tuple[float, float, float]

#: Below this length the mean of the cameras' unit up axes says nothing (they point everywhere).
_SHORTEST_MEAN = 0.1
#: A median over fewer observed points says little; points in the image are taken instead.
_FEWEST_SEEN = 3
#: Points tested against the image of a view that observed too few.
_MOST_TESTED = 50_000


def radial_distances(scene: Scene, views: Sequence[View]) -> NDArray[np.float64]:
    """[V] distance of each camera from the mean training camera centre, local units."""
    middle = scene.centers.mean(axis=0)
    return np.asarray(np.linalg.norm(centers_of(views) - middle, axis=1))


def altitudes(scene: Scene, views: Sequence[View], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V] height of each camera along the unit axis `up` [3] over the mean training camera."""
    middle = scene.centers.mean(axis=0)
    # Not a matrix product: its rounding depends on the number of rows, and a median cut falls
    # exactly on one of them.
    return np.asarray(((centers_of(views) - middle) * up).sum(axis=1))


def upward(scene: Scene, up: Up = "auto") -> tuple[NDArray[np.float64], str]:
    """The scene's unit upward axis [3] in the local frame, and where it comes from.

    `cameras` is the mean of the training cameras' up axes (-y of OpenCV cameras); `pca` the axis of
    least variance of their centres; `auto` takes the cameras' unless they cancel (cameras that look
    straight down in all headings).

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
            "the cameras' up axes cancel",
            where="up",
            expected="cameras that are held upright more often than not",
            todo="set up to pca or to an axis such as [0, 0, 1]",
        )
    return axis / length, "mean of the cameras' up axes"


def _given(up: tuple[float, float, float]) -> NDArray[np.float64]:
    axis = np.array(up, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length == 0.0:
        raise UserError(
            "an upward axis needs a direction",
            where="up",
            expected="three finite numbers that are not all zero",
            found=str(list(up)),
            todo="give the axis as three numbers, such as [0, 0, 1], or leave it on auto",
        )
    return axis / length


def _flattest(scene: Scene) -> NDArray[np.float64]:
    """The axis of least variance of the training cameras' centres, cameras above what they see.

    Its sign puts the cameras above the SfM points or, where there are none, lets them look down.
    """
    centers = scene.centers
    spread = centers - centers.mean(axis=0)
    axis = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    if len(scene.points):
        downward = np.median(scene.points, axis=0) - centers.mean(axis=0)
    else:
        rows = [view.camera.world_to_camera[2, :3].numpy() for view in scene.train_views]
        downward = np.stack(rows).astype(np.float64).mean(axis=0)
    return np.asarray(-axis if float(axis @ downward) > 0.0 else axis)


def footprint_of(scene: Scene, view: View) -> float:
    """`footprint` of a view of the scene."""
    return footprint(view.camera, scene.points, view.seen)


def footprint(camera: Camera, points: NDArray[np.float64], seen: NDArray[np.int64]) -> float:
    """Median of f / z [pixels per local unit] over the SfM points that a camera observed.

    Over those in its image where it observed fewer than 3 in front of it; NaN where there is none.

    Args:
        camera: The camera, in the size of the photo as trained.
        points: [P, 3] SfM points, local frame.
        seen: Rows of `points` that it observed.
    """
    depths = _in_front(camera, points[seen])[:, 2]
    if len(depths) < _FEWEST_SEEN:
        inside = _in_image(camera, points[:: max(1, len(points) // _MOST_TESTED)])[:, 2]
        depths = inside if len(inside) else depths
    if not len(depths):
        return float("nan")
    return float(np.sqrt(camera.fx * camera.fy) / np.median(depths))


def _in_front(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    local = camera.local(points)
    return local[local[:, 2] > 0.0]


def _in_image(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    local = _in_front(camera, points)
    x = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    y = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    return local[(x >= 0.0) & (x < camera.width) & (y >= 0.0) & (y < camera.height)]
