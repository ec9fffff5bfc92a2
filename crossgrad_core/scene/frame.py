"""The local frame: the origin is the mean training camera, the unit is the scene extent."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import stray_rows

# The scene extent is this factor times the largest distance from a training camera to the mean of
# all training cameras (as in 3DGS).
_MARGIN = 1.1

# If the extent of the cameras is below this share of their distance to the scene, the extent is not
# used as the unit.
_SAME_PLACE = 1e-6

# A length below this number of input units counts as 0, because its inverse must be finite.
_SMALLEST = 1e-30

# Local coordinates are rounded to multiples of this number, 1e-9 of the scene extent. If a scene is
# given in other units or with another origin, float64 results differ in their last bits.
# Differences in the last bits are 1e3 to 1e7 times smaller than the rounding step, so that nearly
# all rounded coordinates are equal. The rounding step is 60 times smaller than the spacing of
# float32 numbers near 1.
_GRID = 2.0**-30


@dataclass(frozen=True, eq=False)
class Frame:
    """A local frame, and a note that explains its choice.

    Attributes:
        similarity: Similarity transform from the input frame to the local frame.
        note: A sentence for the log of the run.
        stray: [N] True for training cameras that were ignored because of their large distance from
            all other cameras.
    """

    similarity: Similarity
    note: str
    stray: NDArray[np.bool_]

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points [N, 3] from the input frame to the local frame.

        Round the results to multiples of `_GRID`.
        """
        return _snap(self.similarity.to_local(points))

    def pose(self, world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose [4, 4] in the local frame.

        The rotation is unchanged, and the centre is rounded as in `points`.
        """
        center = self.points(camera_centers(world_to_camera[None]))[0]
        pose = np.eye(4)
        pose[:3, :3] = world_to_camera[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ center
        return pose


def camera_centers(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the camera centres [N, 3] of world-to-camera poses [N, 4, 4]."""
    rotation, translation = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    return np.asarray(-np.einsum("nij,ni->nj", rotation, translation))


def make_frame(centers: NDArray[np.float64], points: NDArray[np.float64]) -> Frame:
    """Choose the local frame of a scene.

    As in 3DGS, the frame depends on the centre and extent of the training cameras.

    Outlier cameras are ignored. If all training cameras are at one position, the unit is the median
    distance from the cameras to the points. Without points, the unit is one input unit.

    Args:
        centers: [N, 3] centres of the training cameras in the input frame; N >= 1.
        points: [P, 3] SfM points in the input frame; may be empty.
    """
    stray = stray_rows(centers, points)
    centers = centers[~stray]
    # Sum the offsets from the first centre, because a sum of large coordinates loses digits.
    origin = centers[0] + (centers - centers[0]).mean(0)
    extent = float(_MARGIN * np.linalg.norm(centers - origin, axis=1).max())
    depth = float(np.median(np.linalg.norm(points - origin, axis=1))) if len(points) else 0.0
    if extent > max(_SAME_PLACE * depth, _SMALLEST):
        return Frame(
            Similarity(origin, 1 / extent),
            f"local frame: 1 unit = {extent:.6g} input units, the extent of the training cameras "
            "(1.1 x largest distance from their mean)",
            stray,
        )
    if depth > _SMALLEST:
        return Frame(
            Similarity(origin, 1 / depth),
            f"local frame: 1 unit = {depth:.6g} input units, the median distance to the "
            "SfM points, because all training cameras have the same position",
            stray,
        )
    return Frame(
        Similarity(origin, 1.0),
        "local frame: 1 unit = 1 input unit, because all training cameras have the "
        "same position and there are no SfM points",
        stray,
    )


def _snap(points: NDArray[np.float64]) -> NDArray[np.float64]:
    # Adding 0 changes -0.0 to 0.0.
    return np.asarray(np.rint(points / _GRID) * _GRID + 0.0)
