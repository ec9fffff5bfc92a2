"""Camera poses of other programs as world-to-camera matrices with OpenCV's axes."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.georeference.frames import SAME, Frame3D

_OPENGL: Final = np.diag([1.0, -1.0, -1.0])


def from_opengl(
    rotation: NDArray[np.float64], center: NDArray[np.float64], frame: Frame3D = SAME
) -> NDArray[np.float64]:
    """[4, 4] world to camera, from a camera in a frame: x right, y up, z backward.

    Args:
        rotation: [3, 3] camera to that frame.
        center: [3] in it.
        frame: From it to the world.
    """
    return from_opencv(rotation @ _OPENGL, center, frame)


def from_opencv(
    rotation: NDArray[np.float64], center: NDArray[np.float64], frame: Frame3D = SAME
) -> NDArray[np.float64]:
    """The same of a camera whose axes are OpenCV's: x right, y down, z forward."""
    pose = np.eye(4)
    pose[:3, :3] = (frame.rotation @ rotation).T
    pose[:3, 3] = -pose[:3, :3] @ frame.points(center[None])[0]
    return pose
