"""The position of a scene on Earth, from any available source."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import (
    Georeference,
    Scene,
    Unplaced,
    UserError,
    View,
    centers_of,
    is_file,
    listed,
)
from crossgrad_core.scene.photos.photos import FilePhoto
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers._json import Fields, read_object
from crossgrad_plugins.readers.place.headers import Measured, of_headers

# Import modules for positions only when they are needed, because most scenes are not georeferenced.
if TYPE_CHECKING:
    from crossgrad_plugins.georeference.ellipsoid import Place
    from crossgrad_plugins.georeference.frames import Fit
    from crossgrad_plugins.georeference.on_earth import OnEarth

#: Files in the scene's folder: OpenDroneMap's list of photo positions, and COLMAP's database.
_LIST: Final = "geo.txt"
_DATABASES: Final = ("database.db", "colmap/database.db")


def at(scene: Scene, place: Georeference) -> Scene:
    """Return the scene with a georeference and a note about it."""
    return replace(scene, georeference=place, notes=(*scene.notes, place.note))


def by_gps(scene: Scene, raw: RawScene, named: Path | None = None) -> Scene:
    """Return the scene, georeferenced by the GPS positions of its photos if there are enough.

    Args:
        scene: The scene.
        raw: The raw scene, from which `scene` was made.
        named: A list of positions, or a folder with the original photos. If `named` is given, no
            other source is used.

    Raises:
        UserError: The source `named` is missing or cannot be read.
    """
    notes: list[str] = []
    for measured in _sources(scene, raw, named, notes):
        shown = [view for view in scene.views if view.name in measured.places]
        if not shown:
            if measured.flat:
                notes.append(f"{measured.source}: {count(measured.flat, 'photo')} without altitude")
            elif measured.strangers:
                names, first = count(len(measured.strangers), "name"), measured.strangers[0]
                notes.append(f"{measured.source}: {names} without a photo, such as {first}")
            elif named is not None:
                notes.append(f"{measured.source}: it contains no position for a photo of the scene")
            continue
        outcome = _fitted(scene, shown, measured)
        if not isinstance(outcome, str):
            return at(replace(scene, notes=(*scene.notes, *notes)), outcome)
        notes.append(outcome)
    if not notes:
        return scene
    return at(scene, Unplaced("; ".join(notes)))


def _sources(
    scene: Scene, raw: RawScene, named: Path | None, notes: list[str]
) -> Iterator[Measured]:
    """Yield the GPS positions of photos, one source after the other."""
    names = [view.name for view in scene.views]
    if named is not None:
        yield _named(named, names)
        return
    for path in (raw.root / name for name in (_LIST, *_DATABASES)):
        if is_file(path):
            try:
                yield _listed(path, names)
            except UserError as error:
                # A run does not need the georeference, so this error becomes a note.
                notes.append(f"{path.name} contains no positions: {error.what} ({error.found})")
    yield of_headers({view.name: _file_of(view, raw) for view in scene.views}, "GPS of the photos")


def _listed(path: Path, names: list[str]) -> Measured:
    """Return the positions in a list or in a COLMAP database."""
    if path.suffix == ".db":
        from crossgrad_plugins.readers.place.files import of_priors

        return of_priors(path, names)
    from crossgrad_plugins.readers.place.files import of_list

    return of_list(path, names)


def _file_of(view: View, raw: RawScene) -> Path:
    """Return the original file of a photo, because a reduced copy may have no EXIF header."""
    path = raw.images / view.name
    if isinstance(view.photo, FilePhoto) and not is_file(path):
        return view.photo.source.path  # The file has another suffix than its name in the scene.
    return path


def _named(path: Path, names: list[str]) -> Measured:
    if path.is_dir():
        return of_headers({name: path / name for name in names}, f"GPS of the photos in {path}")
    if not is_file(path):
        raise UserError(
            "the file or folder with the photo positions does not exist",
            where=f"reader.gps={path}",
            expected="a folder with the original photos, or a list such as geo.txt",
            todo="check the path",
        )
    from crossgrad_plugins.readers.place.files import of_list

    return of_list(path, names)


def _fitted(scene: Scene, views: list[View], measured: Measured) -> "OnEarth | str":
    """Return the position fitted to photos with GPS, or the reason why the fit failed."""
    from crossgrad_plugins.georeference.ellipsoid import geocentric, place_at
    from crossgrad_plugins.georeference.frames import fit_similarity
    from crossgrad_plugins.georeference.on_earth import OnEarth

    places = [measured.places[view.name] for view in views]
    numbers = np.array([[place.latitude, place.longitude, place.altitude] for place in places])
    earth = geocentric(numbers)
    origin = place_at(np.median(earth, axis=0)) or places[0]
    fit = fit_similarity(_centers(scene, views), origin.to_enu.points(earth))
    of = f"{measured.source}, {len(views)} of {len(scene.views)}"
    if isinstance(fit, str):
        flat = f"; {count(measured.flat, 'photo')} without altitude" if measured.flat else ""
        return f"{of}: {fit}{flat}"
    out = [view.name for view, kept in zip(views, fit.kept, strict=True) if not kept]
    left = f", left out {len(out)} that disagree ({listed(sorted(out))})" if out else ""
    return OnEarth(origin, fit.frame, f"{of}{left}", _residuals(fit))


def _residuals(fit: "Fit") -> dict[str, float]:
    """Return the residuals of the photos that were used in the fit, in metres."""
    errors = fit.errors[fit.kept]
    return {
        "rms_horizontal": float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())),
        "rms_vertical": float(np.sqrt((errors[:, 2] ** 2).mean())),
        "max": float(np.linalg.norm(errors, axis=1).max()),
    }


def _centers(scene: Scene, views: list[View]) -> NDArray[np.float64]:
    """Return [N, 3] camera centres in the coordinates of the input."""
    return scene.similarity.to_input(centers_of(views))


def by_code(scene: Scene, code: str) -> Scene:
    """Return the scene with its georeference, for poses in map or geocentric coordinates.

    Args:
        scene: The scene.
        code: The coordinate system, such as `epsg:32633`. The code `epsg:4978` means geocentric
            coordinates on WGS 84.

    Raises:
        UserError: The coordinate system does not exist, does not cover the scene, or has different
            scales along its axes.
    """
    from crossgrad_plugins.georeference.ellipsoid import place_at
    from crossgrad_plugins.georeference.on_earth import OnEarth
    from crossgrad_plugins.georeference.projection import Projection

    where = f"reader.crs={code}"
    projection = Projection.of(code, where)
    middle = scene.similarity.offset
    point = projection.geocentric(middle[None])[0]
    origin = place_at(point) if np.isfinite(point).all() else None
    if origin is None:
        raise UserError(
            "the cameras are outside the area of their coordinate system",
            where=where,
            expected="cameras on Earth",
            found=f"the centre of the cameras at {', '.join(f'{value:.6g}' for value in middle)}",
            todo="check the code, and check that the poses use this coordinate system",
        )
    frame = projection.near(origin.to_enu, np.zeros(3), where).inverse
    source = f"its coordinates in {code.upper()}"
    return at(scene, OnEarth(origin, frame, source, system=projection))


def by_file(scene: Scene, file: Path) -> Scene:
    """Return the scene with the georeference of a `georef.json` (docs/coordinates.md).

    Raises:
        UserError: The file cannot be read, or its transform is not a similarity.
    """
    from crossgrad_plugins.georeference.frames import similarity_of
    from crossgrad_plugins.georeference.on_earth import RESIDUALS, OnEarth

    fields = read_object(file)
    frame = similarity_of(fields.numbers("transform", 4, 4))
    if frame is None:
        expected = "rows of a right-handed similarity, the last one 0, 0, 0, 1"
        fields.wrong("transform", expected)
    stored = fields.inner("residuals_m") if "residuals_m" in fields else Fields({}, file)
    scene = replace(scene, files=(*scene.files, file))
    residuals = {name: stored.number(name) for name in RESIDUALS if name in stored}
    return at(scene, OnEarth(origin_of(fields.inner("origin")), frame, file.name, residuals))


def origin_of(fields: Fields) -> "Place":
    """Return the position that an object gives by latitude, longitude and altitude.

    Raises:
        UserError: A number is missing, or the numbers are not a position on Earth.
    """
    from crossgrad_plugins.georeference.ellipsoid import Place

    for key, most in (("latitude", 90.0), ("longitude", 180.0)):
        if abs(fields.number(key)) > most:
            fields.wrong(key, f"degrees from -{most:g} to {most:g}")
    return Place(*(fields.number(key) for key in ("latitude", "longitude", "altitude")))
