"""Raw scenes for readers of formats with posed photos in a folder and separate points."""

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

#: File names that tools use for points next to the poses. The first existing file is read.
USUAL: Final = ("sparse_pc.ply", "points3D.ply", "points3d.ply", "point_cloud.ply", "points.ply")


def raw_scene(
    inside: Inside, images: str, views: tuple[RawView, ...], points: PointCloud, *notes: str
) -> RawScene:
    """Return the scene of some views, without a split or a background of its own.

    Args:
        inside: The files of the scene.
        images: Photo folder relative to the scene, `.` for the scene's own folder.
        views: The posed photos.
        points: Points in the same frame as the poses.
        notes: Notes on the actions of the reader.
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
    """Return a view that observes no points. `RawView` describes the arguments."""
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
    """Return the points of the named file, or else of a PLY with a usual name, or else no points.

    Args:
        inside: The scene.
        options: If the options name a file of points, no points are read here.
        named: Requested file, relative to `base`.
        where: Place of the name, for error messages.
        frame: Transform from the file's frame to the world.
        base: Folder of the file that names the points.

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
    """The names that a pose file uses for the photos of a folder.

    Attributes:
        files: Name in the pose file -> the only photo in the folder that matches the name.
    """

    files: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path, names: Iterable[str]) -> "PhotoNames":
        """Return the photos in a folder, or no photos if the folder is missing."""
        return cls(PhotoFolder(folder).pair(frozenset(names)).files)

    def full(self, name: str, inside: Inside, where: object) -> str:
        """Return the photo of a name, or the name itself if no photo or several photos match.

        Raises:
            UserError: No photo matches, and the name leads out of the scene.
        """
        return self.files.get(name) or inside.name(name, where)
