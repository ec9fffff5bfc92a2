"""Points that stand in another frame than the cameras are refused."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera
from crossgrad_core.errors import UserError
from crossgrad_core.scene.point_cloud import PointCloud
from crossgrad_core.scene.raw import RawView

#: Points and photos that are tried, and the share of points that some photo has to show.
_TRIED: Final = 1000
_FEWEST: Final = 0.01


def check_seen(
    points: PointCloud, views: Sequence[RawView], where: object, todo: str = "remove the file"
) -> None:
    """Refuses points that hardly any photo shows: they stand in another frame than the cameras.

    Args:
        points: Of the input.
        views: Of the input.
        where: Place of the poses, for the error.
        todo: Another way out for this format.

    Raises:
        UserError: Less than one in a hundred lies in the picture of a photo.
    """
    finite = points.positions[np.isfinite(points.positions).all(axis=1)]
    tried = finite[:: max(1, len(finite) // _TRIED)]
    if not len(tried) or not views:
        return
    shown = np.zeros(len(tried), dtype=np.bool_)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for view in views[:: max(1, len(views) // _TRIED)]:
            shown |= _shown(tried, view)
    if shown.mean() < _FEWEST:
        raise UserError(
            "the points lie in no photo: they stand in another frame than the cameras",
            where=where,
            expected="points in the coordinates of the cameras",
            found=f"{int(shown.sum())} of {len(shown)} points in a photo ({points.source})",
            todo=f"export points and cameras in one frame; or {todo} and start from random points "
            "(--init random)",
        )


def _shown(points: NDArray[np.float64], view: RawView) -> NDArray[np.bool_]:
    """[N] whether a point lies in a photo, up to the distortion of its lens."""
    lens, pose = view.calibration.without_distortion, torch.from_numpy(view.world_to_camera)
    pixels, depth = Camera(**vars(lens), world_to_camera=pose).project(points)
    inside = (pixels >= 0.0) & (pixels <= [lens.width, lens.height])
    return np.asarray(inside.all(axis=1) & (depth > 0.0))
