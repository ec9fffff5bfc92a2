"""The position of a photo, from the GPS tags of its EXIF header."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from PIL.Image import Image

#: Latitude and longitude in degrees, and altitude in metres. Each of the three numbers may be NaN.
Numbers: TypeAlias = tuple[float, float, float]
_IFD: Final = 0x8825
_SOUTH_OR_WEST: Final = {"S", "W"}
#: EXIF values of altitude references for altitudes below sea level and below the ellipsoid.
_BELOW: Final = {1, 3}
_STEPS: Final = (1.0, 60.0, 3600.0)


def gps_of(image: "Image") -> Numbers:
    """Return the position in the tags of a photo; NaN for missing or invalid numbers."""
    tags: Mapping[int, object] = image.getexif().get_ifd(_IFD)
    latitude, longitude = (_degrees(tags.get(side), tags.get(side + 1)) for side in (1, 3))
    below, altitude = tags.get(5), number(tags.get(6))
    if isinstance(below, bytes):
        below = int.from_bytes(below[:1], "big")
    return latitude, longitude, -altitude if below in _BELOW else altitude


def is_place(latitude: float, longitude: float) -> bool:
    """Return True if the degrees are a possible position of a photo on Earth.

    A receiver without a fix writes 0, 0, which is in the sea off Ghana.
    """
    there = abs(latitude) <= 90.0 and abs(longitude) <= 180.0  # noqa: PLR2004 - degrees
    return there and (latitude, longitude) != (0.0, 0.0)


def _degrees(side: object, value: object) -> float:
    """Convert degrees, minutes, seconds to degrees; negative in south and west, NaN if invalid."""
    if not isinstance(value, tuple) or not 1 <= len(value) <= len(_STEPS):
        return math.nan
    degrees = sum(number(component) / step for component, step in zip(value, _STEPS, strict=False))
    return -degrees if str(side).strip("\0 ").upper() in _SOUTH_OR_WEST else degrees


def number(value: object) -> float:
    """Convert a tag or a word to a number; NaN if it is not a number."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan
