"""Where photos were taken, by the pose priors in a database of COLMAP."""

import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final

from crossgrad_core.plugin import UserError
from crossgrad_plugins.georeference.gps_tags import Numbers
from crossgrad_plugins.readers._gps import Measured, measured

_POSITION: Final = struct.Struct("<3d")
_LONGEST: Final = 1 << 20  # bytes of a text, a blob or a row
_WGS84: Final = 0  # of COLMAP's PosePriorCoordinateSystem
#: The column of the photo, in COLMAP 4 and before.
_COLUMNS: Final = ("corr_data_id", "image_id")


def of_priors(path: Path, names: Collection[str]) -> Measured:
    """The GPS positions that COLMAP's feature extraction left in its database.

    Args:
        path: The database.
        names: The photos of the scene.

    Raises:
        UserError: The file is no database, or none of COLMAP.
    """
    try:
        # By `immutable` SQLite writes no file of its own beside it.
        place = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(place, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST)
            rows = _positions(database, frozenset(names), path.stat().st_size)
            found = ((name, _numbers(blob)) for name, blob in rows)
            return measured(found, f"priors in {path.name}")
    except (sqlite3.Error, OSError, UnicodeError) as error:
        raise UserError(
            "the database of COLMAP cannot be read",
            where=path,
            found=str(error),
            todo="make it again with COLMAP, or take it away",
        ) from error


def _positions(
    database: sqlite3.Connection, names: frozenset[str], most: int
) -> Iterator[tuple[str, object]]:
    """Names and positions of photos of the scene; none where the database is older than priors.

    Args:
        database: To be read.
        names: The photos.
        most: Rows of a table that are read; pages that lead to themselves would have no end.
    """
    found = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    tables = {row[0] for row in islice(found, most)}
    if not {"images", "pose_priors"} <= tables:  # Views may compute without an end.
        return
    there = {row[1] for row in database.execute("PRAGMA table_info(pose_priors)")}
    column = next((name for name in _COLUMNS if name in there), None)
    if column is None:
        return
    images = database.execute("SELECT image_id, name FROM images")
    named = {number: name for number, name in islice(images, most) if name in names}
    priors = database.execute(
        f"SELECT {column}, position FROM pose_priors WHERE coordinate_system = {_WGS84}"
    )
    for number, position in islice(priors, most):
        if number in named:
            yield named[number], position


def _numbers(blob: object) -> Numbers | None:
    if not isinstance(blob, bytes) or len(blob) != _POSITION.size:
        return None
    latitude, longitude, altitude = _POSITION.unpack(blob)
    return latitude, longitude, altitude
