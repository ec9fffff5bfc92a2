"""Cameras of a browser window: poses, the fit of a photo into the window, the first view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan, tan
from typing import Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.numerics.rotations import matrix_rows
from crossgrad_core.plugin import Camera, Similarity, View, centers_of

_Floats = NDArray[np.float64]
#: Maximum number of pixels of a frame. A larger window shows an enlarged frame.
MOST_PIXELS: Final = 1920 * 1200
#: Smallest and largest side of a window, in pixels.
_SIDES: Final = (16, 16_384)
#: Two poses are equal up to the rounding of the browser: difference of the rotation's entries, and
#: distance in local units.
_SAME_ROTATION, _SAME_PLACE = 1e-3, 1e-3
#: Length of a drawn camera, as a share of the distance to the next camera and of the scene.
_OF_NEXT, _OF_SCENE = 0.4, 0.03


class Window(Protocol):
    """The camera of a browser window, as viser reports it (OpenCV axes, camera to world)."""

    wxyz: _Floats
    position: _Floats
    fov: float
    image_width: int
    image_height: int


def camera_of(window: Window) -> Camera | None:
    """Return the camera of a browser window; None if its numbers are not those of a camera."""
    width, height = int(window.image_width), int(window.image_height)
    numbers = np.array([*window.wxyz, *window.position, window.fov], dtype=np.float64)
    length = float(np.linalg.norm(numbers[:4]))
    fits = all(_SIDES[0] <= side <= _SIDES[1] for side in (width, height))
    if not (fits and np.isfinite(numbers).all() and length > 0 and 0 < window.fov < np.pi):
        return None
    focal = height / 2 / tan(window.fov / 2)
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(numbers[:4] / length).T
    pose[:3, 3] = -pose[:3, :3] @ numbers[4:7]
    return Camera(width, height, focal, focal, width / 2, height / 2, torch.from_numpy(pose))


def rotation_of(wxyz: _Floats) -> _Floats:
    """Return the [3, 3] rotation of a unit quaternion."""
    return np.array(matrix_rows(*wxyz.tolist()))


def quaternion_of(camera: Camera) -> _Floats:
    """Return the camera-to-world rotation as a unit quaternion wxyz."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(camera.world_to_camera[:3, :3].numpy().T)
    return np.asarray(rotation.as_quat()[[3, 0, 1, 2]], dtype=np.float64)


def fov_of(camera: Camera) -> float:
    """Return the vertical field of view in radians."""
    return 2 * atan(camera.height / 2 / camera.fy)


def moved(camera: Camera, source: Similarity, target: Similarity) -> Camera:
    """Return a camera of one local frame in another local frame of the same files."""
    if source.scale == target.scale and np.array_equal(source.offset, target.offset):
        return camera
    center = target.to_local(source.to_input(camera.center.numpy()[None]))[0]
    pose = camera.world_to_camera.clone()
    pose[:3, 3] = -pose[:3, :3] @ torch.from_numpy(center)
    return replace(camera, world_to_camera=pose)


def looks_like(camera: Camera, view: View) -> bool:
    """Return True if a camera has the pose of a view, up to the rounding of a browser."""
    turned = (camera.world_to_camera - view.camera.world_to_camera)[:3, :3].abs().max()
    away = (camera.center - view.camera.center).norm()
    return float(turned) < _SAME_ROTATION and float(away) < _SAME_PLACE


@dataclass(frozen=True)
class Fit:
    """The place of a drawn image in the frame of a window; the rest of the frame is black.

    Attributes:
        camera: The camera to draw.
        width: Width of the frame in pixels.
        height: Height of the frame in pixels.
        left: Columns left of the image.
        top: Rows above the image.
    """

    camera: Camera
    width: int
    height: int
    left: int = 0
    top: int = 0


def whole_window(camera: Camera, share: float) -> Fit:
    """Return the fit of a free camera, with `share` of the window's side length."""
    share = min(share, (MOST_PIXELS / (camera.width * camera.height)) ** 0.5)
    width, height = (max(1, round(side * share)) for side in (camera.width, camera.height))
    return Fit(camera.resized(width, height), width, height)


def photo_in_window(window: Camera, photo: Camera, share: float = 1.0) -> Fit:
    """Return the fit of a photo into a window, with `share` of the photo's side length.

    A photo that is too large gets a smaller share.
    """
    share = min(share, (MOST_PIXELS / (photo.width * photo.height)) ** 0.5)
    if share < 1.0:
        width, height = (max(1, round(side * share)) for side in (photo.width, photo.height))
        photo = photo.resized(width, height)
    aspect = window.width / window.height
    width = max(photo.width, round(photo.height * aspect))
    height = max(photo.height, round(photo.width / aspect))
    return Fit(photo, width, height, (width - photo.width) // 2, (height - photo.height) // 2)


def fov_in_window(window: Camera, photo: Camera) -> float:
    """Return the vertical field of view, in radians, at which the window shows the whole photo."""
    fit = photo_in_window(window, photo)
    return 2 * atan(fit.height / 2 / fit.camera.fy)


def free_camera() -> Camera:
    """Return a camera in front of the unit cube around the origin, with z upward."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[2, 3] = 3.0
    return Camera(1280, 720, 900.0, 900.0, 640.0, 360.0, torch.from_numpy(pose))


def distance_ahead(view: View, points: _Floats, otherwise: float) -> float:
    """Return the distance from a view to what it shows: the median depth of its SfM points."""
    depths = view.camera.local(points[view.seen])[:, 2]
    depths = depths[depths > 0]
    return float(np.median(depths)) if len(depths) else otherwise


def spacing_of(views: Sequence[View]) -> float:
    """Return the length at which the cameras are drawn, in local units."""
    from scipy.spatial import cKDTree

    centers = centers_of(views)
    if len(centers) < 2:  # noqa: PLR2004 - a camera has no next camera
        return _OF_SCENE
    next_ones = cKDTree(centers).query(centers, k=2)[0][:, 1]
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    return max(min(_OF_NEXT * float(np.median(next_ones)), _OF_SCENE * extent), 1e-4)
