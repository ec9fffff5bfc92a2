"""A COLMAP model as it stands in its files."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image.

    Attributes:
        name: As written in the model.
        camera: Id of its camera.
        quaternion: [4] wxyz, world to camera, not necessarily normalised.
        translation: [3].
        points: [S] uint64 ids of the points that it observes.
    """

    name: str
    camera: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    points: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model as it is in its files.

    Attributes:
        cameras: Camera id -> calibration.
        images: The registered images.
        point_ids: [P] uint64.
        points: [P, 3] float64.
        colors: [P, 3] uint8 RGB.
    """

    cameras: dict[int, Calibration]
    images: tuple[ColmapImage, ...]
    point_ids: NDArray[np.uint64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Number of a camera model -> its name and how many parameters it has."""
    guard_pycolmap()
    import pycolmap

    models = pycolmap.CameraModelId.__members__.items()
    return {
        int(number.value): (
            name,
            len(pycolmap.Camera.create_from_model_name(0, name, 1.0, 1, 1).params),
        )
        for name, number in models
        if name != "INVALID"
    }


def by_id(cameras: Iterable[tuple[int, Calibration]], path: Path) -> dict[int, Calibration]:
    """The cameras by their ids.

    Raises:
        UserError: Two cameras have one id.
    """
    found: dict[int, Calibration] = {}
    for camera, calibration in cameras:
        if camera in found:
            raise _twice("cameras", camera, path)
        found[camera] = calibration
    return found


def check_point_ids(ids: NDArray[np.uint64], path: Path) -> None:
    """Refuses two points of one id.

    Raises:
        UserError: There are such points.
    """
    ordered = np.sort(ids)
    twice = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(twice):
        raise _twice("points", int(ordered[twice[0]]), path)


def _twice(what: str, number: int, path: Path) -> UserError:
    return UserError(
        f"two {what} of the COLMAP model have one id",
        where=path,
        found=f"id {number}",
        todo="export the model again",
    )
