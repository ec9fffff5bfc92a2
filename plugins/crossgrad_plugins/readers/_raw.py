"""Raw scenes of readers that have posed photos in a folder and points beside them."""

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

#: Names under which tools put points beside their poses, the first one that is there is taken.
USUAL: Final = ("sparse_pc.ply", "points3D.ply", "points3d.ply", "point_cloud.ply", "points.ply")


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


@dataclass(frozen=True)
class PhotoNames:
    """Names that a file of poses gives to the photos of a folder.

    Attributes:
        files: Such a name -> the one photo below the folder that it stands for.
    """

    files: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path, names: Iterable[str]) -> "PhotoNames":
        """The photos below a folder; none where it is not there."""
        return cls(PhotoFolder(folder).pair(frozenset(names)).files)

    def full(self, name: str, inside: Inside, where: object) -> str:
        """The photo that a name stands for; the plain name itself where there is none, or several.

        Raises:
            UserError: There is none, and the name leads out of the scene.
        """
        return self.files.get(name) or inside.name(name, where)
