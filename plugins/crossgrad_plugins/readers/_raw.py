"""Raw scenes for readers of formats that have posed photos in a folder, and separate points."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import SceneOptions
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.photo_files import PhotoFolder
from crossgrad_core.scene.point_cloud import NO_POINTS, PointCloud, read_cloud
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_plugins.georeference.frames import SAME, Frame3D
from crossgrad_plugins.readers._inside import Inside, place_of

#: File names of points that programs write beside the poses. The first of these files that exists
#: is read.
USUAL: Final = ("sparse_pc.ply", "points3D.ply", "points3d.ply", "point_cloud.ply", "points.ply")


def raw_scene(
    inside: Inside, images: str, views: tuple[RawView, ...], points: PointCloud, *notes: str
) -> RawScene:
    """Return the scene of some views, without lists of held-out views and without a background.

    Args:
        inside: The files of the scene.
        images: Folder of the photos relative to the scene; `.` for the scene's own folder.
        views: The posed photos.
        points: Points in the coordinates of the poses.
        notes: Notes about changes that the reader made.
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
    """Return a view that has observed no points. The arguments are described at `RawView`."""
    seen = np.zeros(0, dtype=np.int64)
    return RawView(name, calibration, pose, seen, mask, place_of(name))


def find_points(
    inside: Inside,
    options: SceneOptions,
    named: str | None,
    where: object,
    frame: Frame3D = SAME,
    base: str = "",
) -> PointCloud:
    """Return the points of the named file, or of a PLY with a common name, or no points.

    Args:
        inside: The files of the scene.
        options: The reader's options; if they name a file of points, no points are read here.
        named: Requested file relative to `base`, or None.
        where: Position of the name, for error messages.
        frame: Transform from the file's frame to the world.
        base: Folder of the file that contains the name.

    Raises:
        UserError: The named file leads out of the scene, is missing or cannot be read.
    """
    if options.points is not None:
        return NO_POINTS
    if named is not None:
        name = inside.found(named, where, base, inside.points)
        return _placed(read_cloud(inside.file(name, where), name), frame)
    for usual_name in USUAL:
        name = inside.name(usual_name, where, base)
        if (inside.scene / name).is_file():
            return _placed(read_cloud(inside.file(name, where), name), frame)
    return NO_POINTS


def _placed(points: PointCloud, frame: Frame3D) -> PointCloud:
    with np.errstate(over="ignore", invalid="ignore"):
        return PointCloud(frame.points(points.positions), points.colors, points.source)


@dataclass(frozen=True)
class PhotoNames:
    """The names in a pose file of the photos in a folder.

    Attributes:
        files: Name in the pose file -> the only matching photo in the folder.
    """

    files: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path, names: Iterable[str]) -> "PhotoNames":
        """Return the names of the photos in a folder; none if the folder is missing."""
        return cls(PhotoFolder(folder).pair(frozenset(names)).files)

    def full(self, name: str, inside: Inside, where: object) -> str:
        """Return the photo that a name matches.

        Return the name itself if no photo matches, or if several match.

        Raises:
            UserError: No photo matches, and the name leads out of the scene.
        """
        return self.files.get(name) or inside.name(name, where)
