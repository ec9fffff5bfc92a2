"""Points beside a scene: a PLY file of positions and, where it has them, colours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera, UserError
from crossgrad_core.scene.raw import RawView
from crossgrad_plugins.exporters.ply_format.table import read_vertices
from crossgrad_plugins.georeference.frames import SAME, Frame3D
from crossgrad_plugins.readers._inside import Inside

#: Names under which tools put points beside their poses, the first one that is there is taken.
USUAL: Final = ("sparse_pc.ply", "points3D.ply", "points3d.ply", "point_cloud.ply", "points.ply")
_GREY: Final = 127
#: Colours have 16 bits where this percentile of them reaches so much.
_MOST: Final = 99.0
_LONG: Final = 512.0
_COLORS: Final = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
#: Points and photos that are tried, and the share of points that some photo has to show.
_TRIED, _FEWEST = 1000, 0.01


@dataclass(frozen=True, eq=False)
class Points:
    """Points of the input.

    Attributes:
        positions: [P, 3] float64.
        colors: [P, 3] uint8.
        source: File that they come from; empty where there are none.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    source: str = ""

    @property
    def note(self) -> str:
        """Part of a note: how many there are, and from where."""
        if not self.source:
            return "no points"
        return f"{len(self.positions)} points from {self.source}"


NONE: Final = Points(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


def find_points(
    inside: Inside, named: str | None, where: object, frame: Frame3D = SAME, base: str = ""
) -> Points:
    """The points of a scene: of the named PLY file, else of one with a usual name, else none.

    Args:
        inside: The scene.
        named: File that was asked for, relative to `base`.
        where: Place of the name, for errors.
        frame: From the file's frame to the world.
        base: Folder of the file that names it.

    Raises:
        UserError: The named file leads out of the scene, is not there or cannot be read.
    """
    if named is not None:
        name = inside.found(named, where, base, inside.points)
        return _placed(read_points(inside.file(name, where), name), frame)
    for usual in USUAL:
        name = inside.name(usual, where, base)
        if (inside.scene / name).is_file():
            return _placed(read_points(inside.file(name, where), name), frame)
    return NONE


def read_points(path: Path, source: str) -> Points:
    """Positions and colours of the vertices of a PLY file; grey where it has no colours.

    Raises:
        UserError: It is not a PLY file of positions.
    """
    columns = read_vertices(path).columns
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise UserError(
            "PLY file without positions",
            where=path,
            expected="vertices with properties x, y and z",
            found=f"no {', '.join(missing)}",
            todo="export the points again",
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN; those are left out with a note
        positions = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return Points(positions, _colors(columns, len(positions)), source)


def check_seen(
    points: Points, views: Sequence[RawView], where: object, todo: str = "remove the file"
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
    lens, pose = view.calibration, torch.from_numpy(view.world_to_camera)
    # Focal lengths and principal point come first in every model that these readers give.
    fx, fy, cx, cy = lens.params[:4]
    pixels, depth = Camera(lens.width, lens.height, fx, fy, cx, cy, pose).project(points)
    inside = (pixels >= 0.0) & (pixels <= [lens.width, lens.height])
    return np.asarray(inside.all(axis=1) & (depth > 0.0))


def _placed(points: Points, frame: Frame3D) -> Points:
    with np.errstate(over="ignore", invalid="ignore"):
        return Points(frame.points(points.positions), points.colors, points.source)


def _colors(columns: Mapping[str, NDArray[np.generic]], count: int) -> NDArray[np.uint8]:
    """[P, 3] from whole numbers to 255 or to 65,535, or from fractions to 1."""
    names = next((names for names in _COLORS if all(name in columns for name in names)), None)
    if names is None:
        return np.full((count, 3), _GREY, dtype=np.uint8)
    stored = np.stack([columns[name] for name in names], axis=1)
    if stored.dtype == np.uint8:
        return stored
    with np.errstate(invalid="ignore"):
        values = np.nan_to_num(stored.astype(np.float64))
    # Text files hold no types: numbers above 1 are of the whole kind, and far above 255 of the
    # longer one, as scanners write.
    sizes = np.abs(values[np.isfinite(stored)])
    long = len(sizes) > 0 and np.percentile(sizes, _MOST) >= _LONG
    top = 1.0 if sizes.max(initial=0.0) <= 1.0 else 65_535.0 if long else 255.0
    return np.rint(values.clip(0.0, top) * (255.0 / top)).astype(np.uint8)
