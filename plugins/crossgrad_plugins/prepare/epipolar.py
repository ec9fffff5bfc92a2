"""Features of photos as rays, and how far matches are from what two poses make of them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap


class Rays:
    """Features of photos without lens distortion, read when they are asked for, and kept.

    Args:
        cameras: By number; those of the database where one is missing.
        database: COLMAP's database, open.
    """

    def __init__(
        self, cameras: "Mapping[int, pycolmap.Camera]", database: "pycolmap.Database"
    ) -> None:
        self._given, self._database = cameras, database
        self._cameras: dict[int, pycolmap.Camera] = {}
        self._rays: dict[int, NDArray[np.float32]] = {}

    def camera(self, number: int) -> "pycolmap.Camera":
        """The camera of a photo."""
        if number not in self._cameras:
            camera = self._database.read_image(number).camera_id
            self._cameras[number] = (
                self._given[camera] if camera in self._given else self._database.read_camera(camera)
            )
        return self._cameras[number]

    def focal(self, number: int) -> float:
        """The focal length of a photo, pixels."""
        return float(self.camera(number).mean_focal_length())

    def of(self, number: int) -> NDArray[np.float32]:
        """[N, 2] features of a photo in units of the focal length."""
        if number not in self._rays:
            pixels = np.asarray(self._database.read_keypoints(number)[:, :2], dtype=np.float64)
            rays = self.camera(number).cam_from_img(pixels)
            self._rays[number] = np.asarray(rays, dtype=np.float32)
        return self._rays[number]


def off_lines(
    poses: "tuple[pycolmap.Rigid3d, pycolmap.Rigid3d]",
    rays: tuple[NDArray[np.float32], NDArray[np.float32]],
    focals: tuple[float, float],
) -> NDArray[np.float64]:
    """[N] pixels that matches lie from each other's epipolar lines, the larger of both.

    Args:
        poses: Of two photos, world to camera.
        rays: [N, 2] matches in each, in units of the focal length.
        focals: Of each, pixels.
    """
    relative = poses[1] * poses[0].inverse()
    x, y, z = relative.translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ relative.rotation.matrix()
    here, there = (np.column_stack([points, np.ones(len(points))]) for points in rays)
    lines, back = here @ essential.T, there @ essential
    error = np.abs((there * lines).sum(axis=1))
    # Two photos of one place have no epipolar lines, and nothing to contradict.
    tiny = np.finfo(np.float64).tiny
    in_other = error / np.maximum(tiny, np.hypot(lines[:, 0], lines[:, 1])) * focals[1]
    in_one = error / np.maximum(tiny, np.hypot(back[:, 0], back[:, 1])) * focals[0]
    return np.asarray(np.maximum(in_one, in_other))
