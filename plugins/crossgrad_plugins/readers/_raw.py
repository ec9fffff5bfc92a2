"""Raw scenes of readers that have posed photos in a folder, and points beside them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.point_cloud import PointCloud
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_plugins.readers._inside import Inside, place_of


def raw_scene(
    inside: Inside, images: str, views: tuple[RawView, ...], points: PointCloud, *notes: str
) -> RawScene:
    """The scene of some views, without a split or a background of its own.

    Args:
        inside: The files of the scene.
        images: Plain name of the photo folder, `.` for the scene's own.
        views: The posed photos.
        points: In the same frame.
        notes: What the reader did.
    """
    return RawScene(
        root=inside.scene,
        images=inside.scene / images,
        views=views,
        points=points.positions,
        point_colors=points.colors,
        notes=notes,
        files=(inside.scene / points.source,) if points.source else (),
    )


def raw_view(
    name: str, calibration: Calibration, pose: NDArray[np.float64], mask: Path | None = None
) -> RawView:
    """A view that observes no points; see `RawView` for the rest."""
    seen = np.zeros(0, dtype=np.int64)
    return RawView(name, calibration, pose, seen, mask, place_of(name))
