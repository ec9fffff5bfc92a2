"""Checks on what a reader found, before anything is built from it."""

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_core.scene.wording import count, name_some

# Rotations written with six digits pass; a pose with a scale in it does not.
_RIGID = 1e-4


@dataclass(frozen=True, eq=False)
class CheckedPoints:
    """The finite points of a scene.

    Attributes:
        xyz: [P, 3] float64, input frame.
        colors: [P, 3] uint8.
        new_row: [Q] int64, row among the finite points of each point of the input, -1 for none.
    """

    xyz: NDArray[np.float64]
    colors: NDArray[np.uint8]
    new_row: NDArray[np.int64]

    def rows(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """[S'] sorted, distinct rows of the finite points, from rows of the input's points."""
        kept = np.unique(self.new_row[rows])
        return kept[kept >= 0]


def check_views(raw: RawScene) -> None:
    """Refuses scenes with no view, and views that cannot be told apart or placed.

    Raises:
        UserError: See above; names the views.
    """
    if not raw.views:
        raise UserError(
            "the scene has no posed image",
            where=raw.root,
            todo="check that the poses were estimated: at least one image must be registered",
        )
    names = Counter(view.name for view in raw.views)
    twice = [name for name, number in names.items() if number > 1]
    if twice:
        raise UserError(
            "several poses belong to one image name",
            where=raw.root,
            found=name_some(twice),
            todo="keep one image of each name in the model",
        )
    for view in raw.views:
        _check_view(raw, view)


def check_points(raw: RawScene, options: SceneOptions) -> tuple[CheckedPoints, list[str]]:
    """Leaves out points that are not finite, and says so.

    Raises:
        UserError: No point is left and training is to start from the points.
    """
    finite = np.isfinite(raw.points).all(1)
    broken = int((~finite).sum())
    notes = [f"points: {count(broken, 'point')} left out: not finite"] if broken else []
    if not finite.any() and options.init == "points":
        raise UserError(
            "the scene has no SfM points to start from",
            where=raw.root,
            todo="start from random ones (--init random), or from those of a file (--init "
            "FILE.ply)",
        )
    new_row = np.where(finite, np.cumsum(finite) - 1, -1)
    return CheckedPoints(raw.points[finite], raw.point_colors[finite], new_row), notes


def _check_view(raw: RawScene, view: RawView) -> None:
    where = f"{raw.root}: image {view.name}"
    path = PurePosixPath(view.name)
    if not view.name or path.is_absolute() or ".." in path.parts:
        raise UserError(
            "an image name leads out of the image folder",
            where=raw.root,
            expected="a path below the image folder",
            found=repr(view.name),
            todo="rename the image in the model, or export the model again",
        )
    view.calibration.check(where)
    pose = view.world_to_camera
    if not np.isfinite(pose).all():
        raise UserError("a pose is not finite", where=where, todo="remove or re-estimate the image")
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise UserError(
            "a pose is not a rotation and a shift",
            where=where,
            expected="an orthonormal, right-handed rotation",
            found=str(rotation.round(4).tolist()),
            todo="remove the image from the model, or estimate the poses again",
        )
