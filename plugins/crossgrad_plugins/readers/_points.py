"""Points beside a scene: a file of positions and, where it has them, colours."""

from typing import Final

import numpy as np

from crossgrad_core.plugin import SceneOptions
from crossgrad_core.scene.point_cloud import NO_POINTS, PointCloud, read_cloud
from crossgrad_plugins.georeference.frames import SAME, Frame3D
from crossgrad_plugins.readers._inside import Inside

#: Names under which tools put points beside their poses, the first one that is there is taken.
USUAL: Final = ("sparse_pc.ply", "points3D.ply", "points3d.ply", "point_cloud.ply", "points.ply")


def find_points(
    inside: Inside,
    options: SceneOptions,
    named: str | None,
    where: object,
    frame: Frame3D = SAME,
    base: str = "",
) -> PointCloud:
    """The points of a scene: of the named file, else of a PLY with a usual name, else none.

    Args:
        inside: The scene.
        options: Where they name a file of points, that file takes the place of these.
        named: File that was asked for, relative to `base`.
        where: Place of the name, for errors.
        frame: From the file's frame to the world.
        base: Folder of the file that names it.

    Raises:
        UserError: The named file leads out of the scene, is not there or cannot be read.
    """
    if options.points is not None:
        return NO_POINTS
    if named is not None:
        name = inside.found(named, where, base, inside.points)
        return _placed(read_cloud(inside.file(name, where), name), frame)
    for usual in USUAL:
        name = inside.name(usual, where, base)
        if (inside.scene / name).is_file():
            return _placed(read_cloud(inside.file(name, where), name), frame)
    return NO_POINTS


def _placed(points: PointCloud, frame: Frame3D) -> PointCloud:
    with np.errstate(over="ignore", invalid="ignore"):
        return PointCloud(frame.points(points.positions), points.colors, points.source)
