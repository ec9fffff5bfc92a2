"""What tells where photos were taken: headers, lists, priors of COLMAP, and georef.json."""

import io
import json
import math
import sqlite3
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from PIL import Image
from support.places import ORIGIN, TO_ENU, tags_of

from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.georeference import frames, gps_tags
from crossgrad_plugins.georeference.ellipsoid import Place
from crossgrad_plugins.georeference.on_earth import OnEarth
from crossgrad_plugins.readers.place import files, headers
from crossgrad_plugins.readers.place import place as _place
from crossgrad_plugins.readers.place.files import of_list, of_priors
from crossgrad_plugins.readers.place.headers import Measured, of_headers
from crossgrad_plugins.readers.place.place import by_file

_PHOTO, _LIST, _DATABASE, _FILE = "photo.jpg", "geo.txt", "database.db", "georef.json"
_NAMES = ("a.jpg", "b/c.jpg", "d/c.jpg")
_SYSTEMS = (
    *("EPSG:4326", "EPSG:32633", "epsg:4978", "WGS84 UTM 33S", "+proj=longlat +datum=WGS84"),
    *("+proj=utm +zone=33 +south +ellps=WGS84", "EPSG:1", "nonsense"),
)


def _photo(place: Place, altitude: bool = True) -> bytes:
    exif = Image.Exif()
    exif[0x8825] = tags_of(place, altitude)
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG", exif=exif)
    return file.getvalue()


@cache
def _database(column: str) -> bytes:
    """A database of COLMAP 4, or of an earlier one, by the column that names the photo."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / _DATABASE
        database = sqlite3.connect(path)
        database.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        database.execute(
            f"CREATE TABLE pose_priors ({column} INTEGER, position BLOB, coordinate_system INTEGER)"
        )
        for number, name in enumerate(_NAMES):
            database.execute("INSERT INTO images VALUES (?, ?)", (number, name))
            blob = files._POSITION.pack(52.0, 13.0 + number, math.nan if number else 3.0)
            blob = blob[: 24 - 8 * (number == 2)]
            database.execute("INSERT INTO pose_priors VALUES (?, ?, 0)", (number, blob))
        database.execute("INSERT INTO pose_priors VALUES (9, x'', 0)")  # Of a photo elsewhere.
        database.commit()
        database.close()
        return path.read_bytes()


def _seeds() -> Sequence[Case]:
    rows = b"\na.jpg 13.5 52.5 30\nc.jpg 1 2 3\nb/c.jpg 13.6 52.5 31 0 0 0\n\nd/c.jpg 13.6 52.6\n"
    whole = {
        "origin": dict(vars(ORIGIN)),
        "transform": TO_ENU.matrix.tolist(),
        "residuals_m": {"max": 1.5, "photos": 3},
    }
    return [
        {_PHOTO: _photo(ORIGIN)},
        {_PHOTO: _photo(Place(-33.0, -70.0, -5.0))},
        {_PHOTO: _photo(ORIGIN, altitude=False)},
        *({_LIST: system.encode() + rows} for system in _SYSTEMS),
        {_LIST: b""},
        *({_DATABASE: _database(column)} for column in ("corr_data_id", "image_id", "other")),
        {_FILE: json.dumps(whole).encode()},
        {_FILE: json.dumps({**whole, "residuals_m": None}).encode()},
    ]


def _check(measured: Measured) -> None:
    for place in measured.places.values():
        assert abs(place.latitude) <= 90.0
        assert abs(place.longitude) <= 180.0
        assert math.isfinite(place.altitude)


def _parse(folder: Path) -> None:
    _check(of_headers({"a": folder / _PHOTO}, "photos"))
    if (folder / _LIST).is_file():
        _check(of_list(folder / _LIST, _NAMES))
    if (folder / _DATABASE).is_file():
        _check(of_priors(folder / _DATABASE, _NAMES))
    if (folder / _FILE).is_file():
        place = by_file(sample_scene(), folder / _FILE).georeference
        assert isinstance(place, OnEarth)
        assert place.to_enu.scale > 0.0
        place.note.encode()


PLACES = Target(
    name="places",
    seeds=_seeds,
    parse=_parse,
    parser={
        headers: (),
        gps_tags: (),
        files: (),
        # What is made of places that were read.
        _place: ("by_gps", "_sources", "_file_of", "_named", "_fitted", "_residuals", "by_code"),
        frames: ("Frame3D",),
    },
    words=(
        *tuple(system.encode() for system in _SYSTEMS),
        b"nan",
        b"inf",
        b"1e999",
        b"0x1",
        b"1_0",
    ),
    mutators=(matcher(rb"(?<![\w.])(-?\d[-+.\de]*)", NUMBERS),),
)
TARGETS = (PLACES,)
