"""Poses and lenses of other programs, in the terms of COLMAP."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Pinhole, UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_plugins.georeference.frames import SAME, Frame3D

_OPENGL: Final = np.diag([1.0, -1.0, -1.0])
_UNDISTORT = "undistort the photos with the program that posed them and export them as pinhole ones"
_CUT = f"{_UNDISTORT}; cut 360-degree photos into perspective ones first"


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


@dataclass(frozen=True, eq=False)
class Frame(Pinhole):
    """Size, focal lengths and principal point of a lens, to which its distortion is added."""

    @property
    def params(self) -> tuple[float, float, float, float]:
        """In COLMAP's order."""
        return self.fx, self.fy, self.cx, self.cy

    def brown(self, radial: Sequence[float], tangential: Sequence[float]) -> Calibration:
        """Brown's model in OpenCV's terms: k1, k2, k3 and p1, p2.

        The simplest of COLMAP's models that holds it: a pinhole where all are zero.
        """
        k1, k2, k3 = radial
        params = (*self.params, k1, k2, *tangential)
        if k3:
            return self._as("FULL_OPENCV", (*params, k3, 0.0, 0.0, 0.0))
        if any(params[4:]):
            return self._as("OPENCV", params)
        return self._as("PINHOLE", self.params)

    def fisheye(self, radial: Sequence[float]) -> Calibration:
        """OpenCV's equidistant fisheye: k1 to k4."""
        return self._as("OPENCV_FISHEYE", (*self.params, *radial))

    def _as(self, model: str, params: tuple[float, ...]) -> Calibration:
        return Calibration(model, self.width, self.height, params)


def refuse_lens(kind: str, where: object, todo: str = _CUT) -> UserError:
    """The error for cameras that have no pinhole to be undistorted to, or none that is known."""
    return UserError(
        f"photos of {kind} cannot be undistorted",
        where=where,
        expected="a perspective camera, with Brown's distortion or a fisheye's",
        found=kind,
        todo=todo,
    )


def refuse_term(term: str, value: float, where: object) -> UserError:
    """The error for a term of a lens that COLMAP's models lack."""
    return UserError(
        f"the lens has a term that cannot be undistorted: {term}",
        where=where,
        expected=f"{term} = 0",
        found=f"{value:g}",
        todo=f"calibrate again without {term}, or {_UNDISTORT}",
    )
