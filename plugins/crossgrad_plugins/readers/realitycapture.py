"""Reader of RealityCapture (RealityScan) scenes: a CSV of internal and external parameters.

Sources of the format: https://dev.epicgames.com/documentation/realityscan (camera geometry, XMP
camera math). The column `f` is the focal length in millimetres for a 36 mm sensor. The principal
point is measured from the middle of the photo in units of the longer side. Angles are in degrees,
as in nerfstudio's converter: heading is clockwise from north, and pitch 0 looks down. Axes are x
east, y north and alt up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError, read_rows
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.headers import read_header
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.raw import RawView
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._accepts import COLUMNS, NAME_COLUMN, POSE_COLUMNS
from crossgrad_plugins.readers._cameras import Frame, from_opengl, refuse_term
from crossgrad_plugins.readers._columns import Columns, column_names
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._raw import PhotoNames, find_points, raw_scene, raw_view
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder
from crossgrad_plugins.readers.place.place import by_gps

_LENS: Final = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_SENSOR: Final = 36.0  # width of a sensor, mm
_TODO: Final = (
    "export it again: Registration, 'Internal/External camera parameters', as comma-separated text"
)


class RealityCaptureReader(Reader):
    """RealityCapture's CSV of internal and external camera parameters, with a folder of photos.

    Points come from a PLY, because the CSV contains no points.
    """

    images: str = Field("images", description="folder of the photos within the scene")
    file: str | None = Field(
        None,
        description="CSV file within the scene; by default the CSV file with the expected columns",
    )
    points: str | None = Field(
        None, description="PLY file of points within the scene; by default a PLY file in its folder"
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.realitycapture(path, self.file)

    @override
    def nearly_accepts(self, path: Path) -> bool:
        return bool(_accepts.REALITYCAPTURE.find_near(Inside(path)))

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        file = _accepts.REALITYCAPTURE.one(inside, self.file)
        images = inside.name(self.images, "reader.images")
        rows = _rows(file)
        photos = PhotoNames.of(path / images, (row.name for row in rows))
        views = tuple(_view(inside, images, row, photos) for row in rows)
        points = find_points(inside, options, self.points, "reader.points")
        check_seen(points, views, file)
        posed = f"{count(len(views), 'posed image')} from {file.name}"
        note = f"RealityCapture: {posed}, {points.note}"
        raw = raw_scene(inside, images, views, points, note)
        raw = replace(raw, files=(*raw.files, file))
        return by_gps(build_scene(raw, options), raw)


@dataclass(frozen=True)
class _Row:
    """A row of the file: the name of a photo, and numbers by column."""

    name: str
    fields: Fields


def _rows(file: Path) -> list[_Row]:
    """Return the rows that name photos, without empty rows and comments.

    Raises:
        UserError: The file cannot be read, a column is missing, or a row has the wrong number of
            cells.
    """
    columns = Columns.of(file, COLUMNS)
    rows = read_rows(file, "the CSV file of RealityCapture", _TODO, delimiter=columns.delimiter)
    header = columns.names
    missing = [
        name for name in (f"#{NAME_COLUMN}", *POSE_COLUMNS, "f") if name.strip("#") not in header
    ]
    if missing:
        raise _wrong(file, f"a column {missing[0]}", ", ".join(header) or "an empty file")
    twice = [name for name in header if name and header.count(name) > 1]
    if twice:
        raise _wrong(file, "a name for each column", f"the column {twice[0]} twice")
    first = next((i for i, row in enumerate(rows) if column_names(row) == header), None)
    if first is None:
        raise _wrong(file, "a header without quotes", "quotes before the header, or in it")
    photo_rows = []
    for number, row in enumerate(rows[first + 1 :], first + 2):
        cells = [cell.strip(' "') for cell in row]
        if not any(cells) or (cells[0].startswith("#") and len(cells) != len(header)):
            continue
        if len(cells) < len(header) or any(cells[len(header) :]):
            raise _wrong(file, f"{len(header)} cells in line {number}", f"{len(row)} cells")
        named = dict(zip(header, cells, strict=False))
        photo_rows.append(_Row(named[NAME_COLUMN], _numbers(named, file, number)))
    return photo_rows


def _numbers(cells: Mapping[str, str], file: Path, number: int) -> Fields:
    """Return the cells of a row; cells with numbers are converted.

    A cell with other text raises an error only when it is used.

    A comma is accepted as decimal separator.
    """
    values: dict[str, object] = {}
    for name, cell in cells.items():
        try:
            values[name] = float(cell.replace(",", ".")) if "_" not in cell else cell
        except ValueError:
            values[name] = cell
    return Fields(values, file, f"line {number}")


def _wrong(file: Path, expected: str, found: str) -> UserError:
    return UserError(
        "the CSV file of RealityCapture cannot be read",
        where=file,
        expected=expected,
        found=found,
        todo=_TODO,
    )


def _view(inside: Inside, images: str, row: _Row, photos: PhotoNames) -> RawView:
    name = photos.full(row.name, inside, row.fields.where(NAME_COLUMN))
    x, y, up, heading, pitch, roll = (row.fields.number(key) for key in POSE_COLUMNS)
    rotation = rotation_of_angles(heading, pitch, roll)
    pose = from_opengl(rotation, np.array([x, y, up]))
    return raw_view(name, _lens(row.fields, inside.scene / images / name), pose)


def _lens(fields: Fields, photo: Path) -> Calibration:
    """Return the lens of a photo. If the photo is missing, its size is set to 1 x 1 pixel.

    Raises:
        UserError: A number is wrong, or a distortion term has no counterpart in COLMAP's models.
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
    """Return the rotation [3, 3] from camera axes to east, north and up.

    Camera axes are x right, y up and z backward. The angles are in degrees.
    """
    (sh, ch), (sp, cp), (sr, cr) = (
        (np.sin(angle), np.cos(angle)) for angle in np.deg2rad([-heading, pitch, roll])
    )
    about_z = np.array([[ch, -sh, 0.0], [sh, ch, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_y = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    return np.asarray(about_z @ about_x @ about_y)
