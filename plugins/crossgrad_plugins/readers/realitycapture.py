"""Reads scenes of RealityCapture (RealityScan): its CSV of internal and external parameters.

Sources of the format: https://dev.epicgames.com/documentation/realityscan (camera geometry, XMP
camera math): `f` in millimetres of a 36 mm sensor, principal point in units of the longer side from
the middle of the photo. Angles as nerfstudio's converter reads them: heading clockwise from north,
pitch 0 looking down, in degrees; x east, y north, alt up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError, read_rows
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.headers import read_header
from crossgrad_core.scene.raw import RawView
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._accepts import NAME_COLUMN, POSE_COLUMNS
from crossgrad_plugins.readers._colmap_folder import check_scene_folder
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._lenses import Frame, refuse_term
from crossgrad_plugins.readers._photos import PhotoNames
from crossgrad_plugins.readers._place import by_gps
from crossgrad_plugins.readers._points import check_seen, find_points
from crossgrad_plugins.readers._poses import from_opengl
from crossgrad_plugins.readers._raw import raw_scene, raw_view

_LENS: Final = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_SENSOR: Final = 36.0  # mm
_TODO: Final = (
    "export it again: Registration, 'Internal/External camera parameters', as comma-separated text"
)


class RealityCaptureReader(Reader):
    """RealityCapture's CSV of internal and external camera parameters, and photos beside it.

    Points come from a PLY; the CSV has none.
    """

    images: str = Field("images", description="folder of the photos within the scene")
    file: str | None = Field(
        None, description="CSV file within the scene; by itself the one that has its columns"
    )
    points: str | None = Field(
        None, description="PLY of points within the scene; by itself one in its folder"
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.realitycapture(path, self.file)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        file = _accepts.REALITYCAPTURE.one(inside, self.file)
        images = inside.name(self.images, "reader.images")
        photos = PhotoNames.of(path / images)
        views = tuple(_view(inside, images, row, photos) for row in _rows(file))
        points = find_points(inside, self.points, "reader.points")
        check_seen(points, views, file)
        posed = f"{count(len(views), 'posed image')} from {file.name}"
        note = f"RealityCapture: {posed}, {points.note}"
        raw = raw_scene(inside, images, views, points, note)
        return by_gps(build_scene(raw, options), raw)


@dataclass(frozen=True)
class _Row:
    """A row of the file: the photo's name and its numbers by column."""

    name: str
    fields: Fields


def _rows(file: Path) -> list[_Row]:
    """The rows with photos; empty ones are passed over.

    Raises:
        UserError: The file cannot be read, lacks a column, or a row has another number of cells.
    """
    rows = read_rows(file, "the CSV of RealityCapture", _TODO)
    header = [cell.strip() for cell in rows[0]] if rows else []
    missing = [name for name in (NAME_COLUMN, *POSE_COLUMNS, "f") if name not in header]
    if missing:
        raise _wrong(file, f"a column {missing[0]}", ", ".join(header) or "an empty file")
    twice = [name for name in header if name and header.count(name) > 1]
    if twice:
        raise _wrong(file, "a name for each column", f"two columns {twice[0]}")
    found = []
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header) and row:
            raise _wrong(file, f"{len(header)} cells in line {number}", f"{len(row)} cells")
        if row:
            cells = dict(zip(header, row, strict=True))
            found.append(_Row(cells[NAME_COLUMN], _numbers(cells, file, number)))
    return found


def _numbers(cells: Mapping[str, str], file: Path, number: int) -> Fields:
    """The cells of a row with what is a number as one; others are refused when they are used."""
    values: dict[str, object] = {}
    for name, cell in cells.items():
        try:
            values[name] = float(cell) if "_" not in cell else cell
        except ValueError:
            values[name] = cell
    return Fields(values, file, f"line {number}")


def _wrong(file: Path, expected: str, found: str) -> UserError:
    return UserError(
        "the CSV of RealityCapture cannot be read",
        where=file,
        expected=expected,
        found=found,
        todo=_TODO,
    )


def _view(inside: Inside, images: str, row: _Row, photos: PhotoNames) -> RawView:
    where = row.fields.where(NAME_COLUMN)
    name = photos.full(inside.name(row.name, where))
    x, y, up, heading, pitch, roll = (row.fields.number(key) for key in POSE_COLUMNS)
    rotation = rotation_of_angles(heading, pitch, roll)
    pose = from_opengl(rotation, np.array([x, y, up]))
    return raw_view(name, _lens(row.fields, inside.scene / images / name), pose)


def _lens(fields: Fields, photo: Path) -> Calibration:
    """The lens of a photo that is there; the size of others cannot be told.

    Raises:
        UserError: A number is wrong, or a term has no counterpart.
    """
    focal = fields.positive("f")
    px, py, k1, k2, k3, k4, t1, t2 = (fields.number(key, 0.0) for key in _LENS)
    if k4:
        raise refuse_term("k4", k4, fields.where("k4"))
    header = read_header(photo) if photo.is_file() else None
    width, height = (header.width, header.height) if header else (1, 1)
    unit = max(width, height)
    across = focal * unit / _SENSOR
    lens = Frame(
        *(width, height, across, across), px * unit + width / 2.0, py * unit + height / 2.0
    )
    return lens.brown((k1, k2, k3), (t1, t2))


def rotation_of_angles(heading: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """[3, 3] camera (x right, y up, z backward) to east, north, up, from angles in degrees."""
    (sh, ch), (sp, cp), (sr, cr) = (
        (np.sin(angle), np.cos(angle)) for angle in np.deg2rad([-heading, pitch, roll])
    )
    about_z = np.array([[ch, -sh, 0.0], [sh, ch, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_y = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    return np.asarray(about_z @ about_x @ about_y)
