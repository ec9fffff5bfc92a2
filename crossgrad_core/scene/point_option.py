"""The point cloud that `--points` names, in place of the points that a reader found."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from crossgrad_core.errors import UserError
from crossgrad_core.scene.point_cloud import read_cloud
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.system.input_files import is_file


def with_points_of_file(raw: RawScene, option: Path | None) -> RawScene:
    """The scene with the points of a file; no photo is known to have observed any of them.

    Args:
        raw: The scene as a reader found it.
        option: The file, as it is or within the scene; None keeps the points of the reader.

    Raises:
        UserError: The file is not there, cannot be read, holds Gaussians, or stands in another
            frame than the cameras.
    """
    if option is None:
        return raw
    path = next(filter(is_file, (option, raw.root / option)), None)
    if path is None:
        raise UserError(
            "the file of points is not there",
            where=option,
            expected="a PLY, LAS or LAZ file, as it is or within the scene",
            todo="check the path: --points FILE",
        )
    cloud = read_cloud(path, path.name)
    if cloud.gaussians:
        raise UserError(
            "a PLY of Gaussians in place of points",
            where=path,
            expected="positions and colours",
            todo=f"--init {option} starts from its Gaussians",
        )
    check_seen(cloud, raw.views, path, "cut the cloud to what the photos show; or leave it out")
    views = tuple(replace(view, seen=np.zeros(0, dtype=np.int64)) for view in raw.views)
    note = f"points: {len(cloud.positions):,} from {path.name}, in place of those of the scene"
    return replace(
        raw,
        views=views,
        points=cloud.positions,
        point_colors=cloud.colors,
        notes=(*raw.notes, note),
        files=(*raw.files, path),
    )
