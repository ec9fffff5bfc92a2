"""The local frame of a place on Earth: east, north, up."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.readers._poses import Frame3D

#: WGS 84: half the longer axis in metres, and the square of the eccentricity.
_AXIS: Final = 6_378_137.0
_FLATTENING: Final = 1 / 298.257223563
_ECCENTRICITY: Final = _FLATTENING * (2 - _FLATTENING)
#: Farther than this from the surface, in metres, no photo is taken.
_HIGHEST: Final = 100_000.0
_PASSES: Final = 10


def local_frame(place: NDArray[np.float64]) -> tuple[Frame3D | None, str]:
    """From geocentric coordinates to east, north, up around a place [3], and the place in words.

    None where the place is not near the surface of the Earth.
    """
    x, y, z = (float(value) for value in place)
    around = math.hypot(x, y)
    if not abs(math.hypot(around, z) - _AXIS) < _HIGHEST:
        return None, ""
    latitude, longitude = math.atan2(z, around * (1 - _ECCENTRICITY)), math.atan2(y, x)
    for _ in range(_PASSES):
        bend = _AXIS / math.sqrt(1 - _ECCENTRICITY * math.sin(latitude) ** 2)
        latitude = math.atan2(z + _ECCENTRICITY * bend * math.sin(latitude), around)
    (sine, cosine), (sine_l, cosine_l) = (
        (math.sin(angle), math.cos(angle)) for angle in (latitude, longitude)
    )
    rotation = np.array(
        [
            [-sine_l, cosine_l, 0.0],
            [-sine * cosine_l, -sine * sine_l, cosine],
            [cosine * cosine_l, cosine * sine_l, sine],
        ]
    )
    words = f"latitude {math.degrees(latitude):.7f}, longitude {math.degrees(longitude):.7f}"
    return Frame3D(rotation, -rotation @ place), words
