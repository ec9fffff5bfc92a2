"""Poses and lenses of other programs, converted to the conventions of COLMAP."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Pinhole, UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_plugins.georeference.frames import SAME, Frame3D

_OPENGL: Final = np.diag([1.0, -1.0, -1.0])
_UNDISTORT = (
    "undistort the photos with the program that estimated their poses, and "
    "export them with pinhole cameras"
)
_CUT = f"{_UNDISTORT}; cut 360-degree photos into perspective photos first"


def from_opengl(
    rotation: NDArray[np.float64], center: NDArray[np.float64], frame: Frame3D = SAME
) -> NDArray[np.float64]:
    """Return the pose [4, 4], world to camera, of a camera with OpenGL's axes.

    OpenGL's axes are x right, y up, z backward.

    Args:
        rotation: [3, 3] rotation from the camera to the source frame.
        center: [3] camera centre in the source frame, in which the other program gives poses.
        frame: Transform from the source frame to the world.
    """
    return from_opencv(rotation @ _OPENGL, center, frame)


def from_opencv(
    rotation: NDArray[np.float64], center: NDArray[np.float64], frame: Frame3D = SAME
) -> NDArray[np.float64]:
    """Return the pose [4, 4] of a camera with OpenCV's axes: x right, y down, z forward."""
    pose = np.eye(4)
    pose[:3, :3] = (frame.rotation @ rotation).T
    pose[:3, 3] = -pose[:3, :3] @ frame.points(center[None])[0]
    return pose


@dataclass(frozen=True, eq=False)
class Frame(Pinhole):
    """Image size, focal lengths and principal point of a camera, without lens distortion."""

    @property
    def params(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point, in COLMAP's order."""
        return self.fx, self.fy, self.cx, self.cy

    def brown(self, radial: Sequence[float], tangential: Sequence[float]) -> Calibration:
        """Return the calibration with Brown's distortion k1, k2, k3, p1, p2, as named by OpenCV.

        The simplest COLMAP model with all non-zero terms is used, and a pinhole if all terms are
        zero.
        """
        k1, k2, k3 = radial
        params = (*self.params, k1, k2, *tangential)
        if k3:
            return self._as("FULL_OPENCV", (*params, k3, 0.0, 0.0, 0.0))
        if any(params[4:]):
            return self._as("OPENCV", params)
        return self._as("PINHOLE", self.params)

    def fisheye(self, radial: Sequence[float]) -> Calibration:
        """Return the calibration of OpenCV's equidistant fisheye with k1 to k4."""
        return self._as("OPENCV_FISHEYE", (*self.params, *radial))

    def _as(self, model: str, params: tuple[float, ...]) -> Calibration:
        return Calibration(model, self.width, self.height, params)


def refuse_lens(kind: str, where: object, todo: str = _CUT) -> UserError:
    """Return the error for cameras that cannot be undistorted to a known pinhole camera."""
    return UserError(
        f"photos of {kind} cannot be undistorted",
        where=where,
        expected="a perspective camera with Brown's distortion or a fisheye distortion",
        found=kind,
        todo=todo,
    )


def refuse_term(term: str, value: float, where: object) -> UserError:
    """Return the error for a lens term that no camera model of COLMAP has."""
    return UserError(
        f"the lens model has a term that crossgrad cannot undistort: {term}",
        where=where,
        expected=f"{term} = 0",
        found=f"{value:g}",
        todo=f"calibrate again without {term}, or {_UNDISTORT}",
    )
