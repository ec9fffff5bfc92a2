"""The raw scene: the result of a reader before split and local frame are chosen, with checks."""

import os
import re
import unicodedata
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.frame import Frame, camera_centers
from crossgrad_core.scene.wording import count, name_some

#: Coordinates above this number of input units are invalid, because their squares could overflow
#: float64.
FARTHEST = 1e30
#: Largest allowed coordinate in local units. The square of this coordinate does not overflow
#: float32.
FARTHEST_LOCAL = 1e15
#: Largest number of bytes that usual file systems allow for a file or folder name, and for a
#: complete path.
LONGEST_PART, LONGEST_NAME = 255, 1024
_NO_SIGNS = {"Cc", "Cs"}  # Control characters, and bytes that are not valid UTF-8.
# Tolerance for checking that a pose is rigid. Rotations that are written with six digits pass the
# check; poses that contain a scale fail.
_RIGID = 1e-4


@dataclass(frozen=True, eq=False)
class RawView:
    """An image with a pose, as the input describes it.

    Attributes:
        name: Path below the image folder with forward slashes. Each name occurs only once.
        calibration: Calibration of the camera before undistortion and resizing.
        world_to_camera: [4, 4] float64 rigid transform from the input frame to the camera frame
            (OpenCV axes).
        seen: [S] int64 rows of the points that the view observes; may be empty.
        mask: Path of the mask, if the input names a mask. The option for the mask folder has
            priority.
        place: Path whose folders determine the regime of the view. If `place` is None, the path
            `name` is used.
    """

    name: str
    calibration: Calibration
    world_to_camera: NDArray[np.float64]
    seen: NDArray[np.int64]
    mask: Path | None = None
    place: str | None = None


@dataclass(frozen=True, eq=False)
class RawScene:
    """A scene as the input describes it.

    `crossgrad_core.scene.build` converts a `RawScene` to a `Scene`.

    Attributes:
        root: Folder of the scene. The folder may contain split lists and the default mask folder.
            The name of the folder becomes the scene's name.
        images: Folder of the photos. The neighbouring folders `<images>_2`, `_4` and `_8` may
            contain smaller copies.
        views: The images with poses, in any order.
        points: [P, 3] float64 SfM points in the input frame; may be empty.
        point_colors: [P, 3] uint8 RGB colours of the points.
        notes: Notes about changes that the reader made to the input.
        split: Names of the training and of the held-out views; None if the input prescribes no
            split.
        background: RGB in [0, 1] behind transparent pixels. If `background` is None, all pixels
            with alpha below one half are masked.
        files: Paths of the files that the reader used, except photos and masks.
    """

    root: Path
    images: Path
    views: tuple[RawView, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    notes: tuple[str, ...] = ()
    split: tuple[frozenset[str], frozenset[str]] | None = None
    background: tuple[float, float, float] | None = None
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class CheckedPoints:
    """The points of a scene that are finite.

    Attributes:
        xyz: [P, 3] float64 positions in the input frame.
        colors: [P, 3] uint8 RGB colours.
        new_row: [Q] int64: for each input point, its row among the finite points; -1 if the point
            was removed.
    """

    xyz: NDArray[np.float64]
    colors: NDArray[np.uint8]
    new_row: NDArray[np.int64]

    def rows(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert rows of input points to sorted, distinct rows [S'] of finite points."""
        kept = np.unique(self.new_row[rows])
        return kept[kept >= 0]

    def selected(self, chosen: NDArray[np.bool_]) -> "CheckedPoints":
        """Return the points for which `chosen` [P] is True."""
        numbers = np.append(np.where(chosen, np.cumsum(chosen) - 1, -1), -1)
        return CheckedPoints(self.xyz[chosen], self.colors[chosen], numbers[self.new_row])


def is_possible_name(text: str) -> bool:
    """Return True if a path is a valid file name on all usual file systems."""
    if any(unicodedata.category(sign) in _NO_SIGNS for sign in text):
        return False
    longest = max(len(os.fsencode(part)) for part in re.split(r"[/\\]", text))
    return longest <= LONGEST_PART and len(os.fsencode(text)) <= LONGEST_NAME


def check_views(raw: RawScene) -> None:
    """Raise an error if the scene contains no views, ambiguous names, or invalid poses.

    Raises:
        UserError: The scene or a view is not valid. The message names the views.
    """
    if not raw.views:
        raise UserError(
            "the scene has no image with a pose",
            where=raw.root,
            todo="estimate the poses again: at least one image must be registered",
        )
    for view in raw.views:
        _check_name(raw, view.name)
    names = Counter(str(PurePosixPath(view.name)) for view in raw.views)
    twice = [name for name, number in names.items() if number > 1]
    if twice:
        raise UserError(
            "several images of the model have the same name",
            where=raw.root,
            found=name_some(twice),
            todo="keep only one image of each name in the model",
        )
    for view in raw.views:
        _check_view(raw, view)


def check_points(raw: RawScene) -> tuple[CheckedPoints, list[str]]:
    """Remove points that are not finite, and return a note with their number."""
    # The comparison is also False for NaN.
    finite = np.asarray((np.abs(raw.points) <= FARTHEST).all(1))
    broken = int((~finite).sum())
    notes = [f"points: {count(broken, 'point')} left out (not finite)"] if broken else []
    new_row = np.where(finite, np.cumsum(finite) - 1, -1)
    return CheckedPoints(raw.points[finite], raw.point_colors[finite], new_row), notes


def check_distances(
    raw: RawScene, points: CheckedPoints, frame: Frame
) -> tuple[CheckedPoints, list[str]]:
    """Remove points too far from the training cameras for single precision, and return a note.

    Raises:
        UserError: A camera is too far from the training cameras.
    """
    poses = np.stack([view.world_to_camera for view in raw.views])
    centers = np.abs(frame.similarity.to_local(camera_centers(poses))).max(1)
    if centers.max() > FARTHEST_LOCAL:
        raise UserError(
            "a camera is too far from the training cameras",
            where=f"{raw.root}: image {raw.views[int(centers.argmax())].name}",
            expected=f"at most {FARTHEST_LOCAL:g} times their extent",
            found=f"{centers.max():.3g} times",
            todo="remove or re-estimate the image",
        )
    near = np.abs(frame.similarity.to_local(points.xyz)).max(1, initial=0.0) <= FARTHEST_LOCAL
    far = int((~near).sum())
    if not far:
        return points, []
    return points.selected(near), [
        (
            f"points: {count(far, 'point')} left out (farther away than "
            f"{FARTHEST_LOCAL:g} times the extent of the training cameras)"
        )
    ]


def _check_name(raw: RawScene, name: str) -> None:
    path = PurePosixPath(name)
    absolute = path.is_absolute() or PureWindowsPath(name).drive
    if not path.name or absolute or ".." in path.parts:
        raise UserError(
            "an image name leads out of the image folder",
            where=raw.root,
            expected="a path below the image folder",
            found=repr(name),
            todo="rename the image in the model and its photo below the image folder",
        )
    if not is_possible_name(name):
        raise UserError(
            "an image name is not valid",
            where=raw.root,
            expected=f"UTF-8 without control characters, at most {LONGEST_PART} bytes for a file "
            f"or folder and {LONGEST_NAME} in all",
            found=ascii(name),
            todo="rename the image in the model and its photo",
        )


def _check_view(raw: RawScene, view: RawView) -> None:
    where = f"{raw.root}: image {view.name}"
    view.calibration.check(where)
    pose = view.world_to_camera
    if not (np.abs(pose) <= FARTHEST).all():  # The comparison is also False for NaN.
        raise UserError(
            "a pose contains numbers that are not finite",
            where=where,
            todo="remove the image, or estimate its pose again",
        )
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise UserError(
            "a pose does not consist of a rotation and a translation",
            where=where,
            expected="an orthonormal, right-handed rotation",
            found=str(rotation.round(4).tolist()),
            todo="remove the image from the model, or estimate the poses again",
        )
