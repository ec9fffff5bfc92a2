"""Positions on the ellipsoid WGS 84, geocentric coordinates, and local east, north and up."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.georeference.frames import Frame3D

#: WGS 84: semi-major axis in metres, flattening, and square of the eccentricity.
_AXIS: Final = 6_378_137.0
_FLATTENING: Final = 1 / 298.257223563
_ECCENTRICITY: Final = _FLATTENING * (2 - _FLATTENING)
#: Maximum distance of a photo from the Earth's surface, in metres.
_HIGHEST: Final = 100_000.0
_PASSES: Final = 10


@dataclass(frozen=True)
class Place:
    """A position on Earth: degrees north and east, and metres above the ellipsoid."""

    latitude: float
    longitude: float
    altitude: float

    @property
    def text(self) -> str:
        """Latitude and longitude as text, to a centimetre."""
        return f"latitude {self.latitude:.7f}, longitude {self.longitude:.7f}"

    @property
    def to_enu(self) -> Frame3D:
        """The conversion from geocentric coordinates to east, north and up of this position."""
        sine, cosine, sine_l, cosine_l = (
            *(math.sin(math.radians(self.latitude)), math.cos(math.radians(self.latitude))),
            *(math.sin(math.radians(self.longitude)), math.cos(math.radians(self.longitude))),
        )
        rotation = np.array(
            [
                [-sine_l, cosine_l, 0.0],
                [-sine * cosine_l, -sine * sine_l, cosine],
                [cosine * cosine_l, cosine * sine_l, sine],
            ]
        )
        here = geocentric(np.array([[self.latitude, self.longitude, self.altitude]]))[0]
        return Frame3D(rotation, -rotation @ here)


def geocentric(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return geocentric coordinates [N, 3], m, of latitudes, longitudes (degrees) and altitudes."""
    latitude, longitude = np.radians(places[:, :2]).T
    bend = _AXIS / np.sqrt(1 - _ECCENTRICITY * np.sin(latitude) ** 2)
    around = (bend + places[:, 2]) * np.cos(latitude)
    polar = (bend * (1 - _ECCENTRICITY) + places[:, 2]) * np.sin(latitude)
    return np.column_stack([around * np.cos(longitude), around * np.sin(longitude), polar])


def place_at(point: NDArray[np.float64]) -> Place | None:
    """Return the position of geocentric coordinates [3]; None if far from the Earth's surface."""
    x, y, z = (float(value) for value in point)
    around = math.hypot(x, y)
    if not abs(math.hypot(around, z) - _AXIS) < _HIGHEST:
        return None
    latitude = math.atan2(z, around * (1 - _ECCENTRICITY))
    for _ in range(_PASSES):
        bend = _AXIS / math.sqrt(1 - _ECCENTRICITY * math.sin(latitude) ** 2)
        latitude = math.atan2(z + _ECCENTRICITY * bend * math.sin(latitude), around)
    sine, cosine = math.sin(latitude), math.cos(latitude)
    # Compute the altitude along the vertical. This formula also holds at the poles and at the
    # equator.
    flat = _AXIS * math.sqrt(1 - _ECCENTRICITY * sine**2)
    altitude = around * cosine + z * sine - flat
    return Place(math.degrees(latitude), math.degrees(math.atan2(y, x)), altitude)
