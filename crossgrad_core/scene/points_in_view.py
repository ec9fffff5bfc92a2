"""Check that points and cameras are in a common coordinate frame."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera
from crossgrad_core.errors import UserError
from crossgrad_core.scene.frame import camera_centers
from crossgrad_core.scene.point_cloud import PointCloud
from crossgrad_core.scene.raw import RawView

#: `_TRIED`: approximate number of tested points, and of tested photos. `_FEWEST`: minimum share
#: of the tested points that must be inside at least one photo.
_TRIED: Final = 1000
_FEWEST: Final = 0.01
#: If photos show at least this share of the points after a change of the poses, the poses are
#: probably wrong.
_REPAIRED: Final = 0.5

_Change: TypeAlias = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def _inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse [4, 4] of a rigid pose."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = camera_centers(pose[None])[0]
    return inverse


#: Converts the camera axes from OpenGL to OpenCV, and from OpenCV to OpenGL.
_FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])
#: Mistakes in poses after which no photo shows the points.
_MISTAKES: Final[tuple[tuple[str, _Change], ...]] = (
    (
        "the camera axes follow another convention (OpenGL: y up, z backward)",
        lambda pose: _FLIP @ pose,
    ),
    ("the poses are inverted (camera to world, or world to camera)", _inverse),
    (
        "the poses are inverted (camera to world, or world to camera)",
        lambda pose: _FLIP @ _inverse(_FLIP @ pose),
    ),
    (
        (
            "the poses are inverted, and the camera axes follow another convention "
            "(OpenGL: y up, z backward)"
        ),
        lambda pose: _inverse(_FLIP @ pose),
    ),
)


def check_seen(
    points: PointCloud, views: Sequence[RawView], where: object, todo: str = "remove the file"
) -> None:
    """Raise an error if almost no photo shows the points.

    If almost no photo shows the points, points and cameras have different frames.

    Args:
        points: The points of the input.
        views: The views of the input.
        where: File of the poses, for the error message.
        todo: Alternative remedy for the format of the input.

    Raises:
        UserError: Less than one percent of the points are inside a photo.
    """
    finite = points.positions[np.isfinite(points.positions).all(axis=1)]
    tried = finite[:: max(1, len(finite) // _TRIED)]
    if not len(tried) or not views:
        return
    shown = np.asarray(_shown_by(tried, views, lambda pose: pose).any(axis=0))
    if shown.mean() >= _FEWEST:
        return
    cause = _likely_cause(tried, views)
    raise UserError(
        "no photo shows the SfM points: "
        + (f"{cause}" if cause else "the points are in another coordinate system than the cameras"),
        where=where,
        expected="points in the coordinate system of the cameras",
        found=f"{int(shown.sum())} of {len(shown)} points visible in a photo ({points.source})",
        todo="correct the poses; the photos will then show the points"
        if cause
        else (
            f"export points and cameras in one coordinate system; or {todo} and start "
            "from random points (--init random)"
        ),
    )


def _likely_cause(points: NDArray[np.float64], views: Sequence[RawView]) -> str | None:
    """Return the mistake in the poses whose correction makes photos show the most points.

    Return None without a likely mistake.
    """
    best, cause = _REPAIRED, None
    for text, change in _MISTAKES:
        shown = _shown_by(points, views, change)
        share = float(shown.any(axis=0).mean())
        if share > best and np.median(shown.mean(axis=1)) >= _FEWEST:
            best, cause = share, text
    return cause


def _shown_by(
    points: NDArray[np.float64], views: Sequence[RawView], change: _Change
) -> NDArray[np.bool_]:
    """Return a mask [V, N] of the points inside each photo, after `change` modified the poses."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return np.stack(
            [
                _shown(points, replace(view, world_to_camera=change(view.world_to_camera)))
                for view in views[:: max(1, len(views) // _TRIED)]
            ]
        )


def _shown(points: NDArray[np.float64], view: RawView) -> NDArray[np.bool_]:
    """Return a mask [N] of the points inside a photo. Lens distortion is ignored."""
    lens, pose = view.calibration.without_distortion, torch.from_numpy(view.world_to_camera)
    pixels, depth = Camera(**vars(lens), world_to_camera=pose).project(points)
    inside = (pixels >= 0.0) & (pixels <= [lens.width, lens.height])
    return np.asarray(inside.all(axis=1) & (depth > 0.0))
