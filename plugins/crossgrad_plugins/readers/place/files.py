"""Positions of photos from a file: OpenDroneMap's geo.txt, or a COLMAP database."""

import math
import re
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np

from crossgrad_core.plugin import UserError, read_file
from crossgrad_plugins.georeference.ellipsoid import place_at
from crossgrad_plugins.georeference.gps_tags import Numbers, number
from crossgrad_plugins.georeference.projection import Projection
from crossgrad_plugins.readers.place.headers import Measured, measured

#: Number of bytes in memory that each word of a list needs.
_WORD: Final = 64
_DEGREES: Final = re.compile(r"epsg:4326|wgs ?84|\+proj=(longlat|latlong)\b.*", re.IGNORECASE)
_ZONE: Final = "(0?[1-9]|[1-5][0-9]|60)"
_UTM: Final = re.compile(f"wgs ?84 utm {_ZONE} ?([ns])", re.IGNORECASE)
_PROJ_UTM: Final = re.compile(
    rf"\+proj=utm \+zone={_ZONE}( \+south)?( \+(datum|ellps)=WGS84| \+units=m| \+no_defs"
    r"| \+type=crs)*"
)
_SHOWN: Final = 80
_POSITION: Final = struct.Struct("<3d")
_LONGEST: Final = 1 << 20  # maximum number of bytes of a text, a blob or a row
_WGS84: Final = 0  # a value of COLMAP's PosePriorCoordinateSystem
#: Names of the column with the photo's id: in COLMAP 4, and in older versions.
_COLUMNS: Final = ("corr_data_id", "image_id")


def of_list(path: Path, names: Collection[str]) -> Measured:
    """Return the positions in a list.

    The first line gives the coordinate system, such as `EPSG:4326` for longitude and latitude. Each
    other line gives the name of a photo, x, y and altitude. Further words in a line are ignored.

    Args:
        path: The file.
        names: Names of the scene's photos. In the list, names may lack folders, and may have
            another suffix or letter case.

    Raises:
        UserError: The file cannot be read, a line lacks numbers, or the coordinate system is
            unknown.
    """
    first, *lines = [line.split() for line in _text(path).splitlines()] or [[]]
    rows = {words[0]: _row(path, i, words) for i, words in enumerate(lines, 2) if words}
    exact, to_degrees = _by_file(names), _system(" ".join(first), path)
    photos = {name: exact[name] for name in rows if name in exact}
    loose, others = _by_file(names, _folded), [name for name in rows if name not in exact]
    times = Counter(map(_folded, others))
    for name in others:
        # A name that matches several photos is ignored; an exact match has priority.
        photo = loose.get(_folded(name)) if times[_folded(name)] == 1 else None
        if photo is not None and photo not in photos.values():
            photos[name] = photo
    positions = ((photo, to_degrees(rows[name])) for name, photo in photos.items())
    strangers = tuple(name for name in rows if name not in photos)
    return replace(measured(positions, path.name), strangers=strangers)


def _text(path: Path) -> str:
    try:
        return read_file(path, {b" ": _WORD, b"\n": _WORD}).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise _wrong(path, "a text file in UTF-8", str(error)) from error


def _row(path: Path, line: int, words: list[str]) -> Numbers:
    """Return x, y and altitude. A missing altitude is returned as NaN."""
    x, y, z = [*map(number, words[1:4]), *[math.nan] * 3][:3]
    if not math.isfinite(x) or not math.isfinite(y):
        shown = " ".join(words)[:_SHOWN]
        raise _wrong(path, f"a name, x, y and altitude in line {line}", shown)
    return x, y, z


def _wrong(path: Path, expected: str, found: str) -> UserError:
    return UserError(
        "the list of photo positions cannot be read",
        where=path,
        expected=expected,
        found=found,
        todo="correct it (docs/coordinates.md describes the format), or remove it",
    )


def _folded(name: str) -> str:
    folder, _, file = name.rpartition("/")
    return f"{folder}/{file.rpartition('.')[0] or file}".casefold()


def _by_file(names: Collection[str], said: Callable[[str], str] = str) -> dict[str, str]:
    """Return the photos that the names in `said` match.

    A name matches by its whole path, or by its file name if only one photo has this name.
    """
    files = {name: said(PurePosixPath(name).name) for name in names}
    whole = {name: said(name) for name in names}
    photos: dict[str, str] = {}
    for called in (files, whole):
        often = Counter(called.values())
        photos |= {text: name for name, text in called.items() if often[text] == 1}
    return photos


def _system(text: str, path: Path) -> Callable[[Numbers], Numbers | None]:
    """Return a function that converts coordinates of a coordinate system to degrees.

    Raises:
        UserError: The coordinate system does not exist, or pyproj is not installed.
    """
    if _DEGREES.fullmatch(text):
        return lambda xyz: (xyz[1], xyz[0], xyz[2])
    utm = _UTM.fullmatch(text) or _PROJ_UTM.fullmatch(text)
    if utm:
        south = (utm[2] or "n").strip() in {"s", "S", "+south"}
        text = f"epsg:{(32700 if south else 32600) + int(utm[1])}"
    projection = Projection.of(text, str(path))

    def on_earth(xyz: Numbers) -> Numbers | None:
        flat = math.isnan(xyz[2])
        point = projection.geocentric(np.array([[*xyz[:2], 0.0 if flat else xyz[2]]]))[0]
        place = place_at(point) if np.isfinite(point).all() else None
        if place is None:
            return None
        return place.latitude, place.longitude, math.nan if flat else place.altitude

    return on_earth


def of_priors(path: Path, names: Collection[str]) -> Measured:
    """Return the GPS positions that COLMAP's feature extraction wrote to its database.

    Args:
        path: The database.
        names: Names of the scene's photos.

    Raises:
        UserError: The file is not a database of COLMAP.
    """
    try:
        # With `immutable`, SQLite creates no files beside the database.
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST)
            rows = _positions(database, frozenset(names), path.stat().st_size)
            positions = ((name, _numbers(blob)) for name, blob in rows)
            return measured(positions, f"priors in {path.name}")
    except (sqlite3.Error, OSError, UnicodeError) as error:
        raise UserError(
            "the COLMAP database cannot be read",
            where=path,
            found=str(error),
            todo="create it again with COLMAP, or remove it",
        ) from error


def _positions(
    database: sqlite3.Connection, names: frozenset[str], most: int
) -> Iterator[tuple[str, object]]:
    """Yield names and positions of photos of the scene; nothing if the database has no positions.

    Args:
        database: The opened database.
        names: Names of the scene's photos.
        most: Maximum number of rows that are read from a table. Without this limit, damaged pages
            could form an endless loop.
    """
    table_rows = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    tables = {row[0] for row in islice(table_rows, most)}
    # Refuse databases that contain SQL views, because reading a view may never end.
    if not {"images", "pose_priors"} <= tables:
        return
    there = {row[1] for row in database.execute("PRAGMA table_info(pose_priors)")}
    column = next((name for name in _COLUMNS if name in there), None)
    if column is None:
        return
    images = database.execute("SELECT image_id, name FROM images")
    named = {image: name for image, name in islice(images, most) if name in names}
    priors = database.execute(
        f"SELECT {column}, position FROM pose_priors WHERE coordinate_system = {_WGS84}"
    )
    for image, position in islice(priors, most):
        if image in named:
            yield named[image], position


def _numbers(blob: object) -> Numbers | None:
    if not isinstance(blob, bytes) or len(blob) != _POSITION.size:
        return None
    latitude, longitude, altitude = _POSITION.unpack(blob)
    return latitude, longitude, altitude
