"""Places on Earth in a local frame: east, north, up in metres."""

from collections.abc import Sequence
from statistics import median

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.prepare.plan import Plan, Position

#: Degrees of longitude in half a turn.
_HALF = 180.0


def origin_of(plan: Plan) -> Position | None:
    """The middle of where the photos were taken; None where none has GPS."""
    places = [photo.position for photo in plan.located if photo.position is not None]
    if not places:
        return None
    longitudes = [place.longitude for place in places]
    if max(longitudes) - min(longitudes) > _HALF:
        # On both sides of the date line.
        longitudes = [each % (2 * _HALF) for each in longitudes]
    east = median(longitudes)
    return Position(
        latitude=median(place.latitude for place in places),
        longitude=east - 2 * _HALF if east > _HALF else east,
        altitude=median(place.altitude for place in places),
    )


def local_positions(plan: Plan) -> dict[str, NDArray[np.float64]]:
    """Name -> [3] metres east, north, up of the origin, of each photo with GPS (WGS 84)."""
    origin = origin_of(plan)
    if origin is None:
        return {}
    names = [photo.name for photo in plan.located]
    places = [photo.position for photo in plan.located if photo.position is not None]
    return dict(zip(names, _to_local(places, origin), strict=True))


def _to_local(places: Sequence[Position], origin: Position) -> NDArray[np.float64]:
    """[N, 3]."""
    guard_pycolmap()
    import pycolmap

    angles = np.array([[each.latitude, each.longitude, each.altitude] for each in places])
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(
        transform.ellipsoid_to_enu(angles, origin.latitude, origin.longitude, origin.altitude)
    )
