"""The position of a photo, from the GPS tags of its EXIF header."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from PIL.Image import Image

#: Latitude and longitude in degrees, and altitude in metres. Each of the numbers may be NaN.
Numbers: TypeAlias = tuple[float, float, float]
_IFD: Final = 0x8825
_SOUTH_OR_WEST: Final = {"S", "W"}
#: EXIF values of the altitude reference for altitudes below sea level and below the ellipsoid.
_BELOW: Final = {1, 3}
_STEPS: Final = (1.0, 60.0, 3600.0)


def gps_of(image: "Image") -> Numbers:
    """Return the position from the tags of a photo; missing or invalid numbers are NaN."""
    tags: Mapping[int, object] = image.getexif().get_ifd(_IFD)
    latitude, longitude = (_degrees(tags.get(side), tags.get(side + 1)) for side in (1, 3))
    below, altitude = tags.get(5), number(tags.get(6))
    if isinstance(below, bytes):
        below = int.from_bytes(below[:1], "big")
    return latitude, longitude, -altitude if below in _BELOW else altitude


def is_place(latitude: float, longitude: float) -> bool:
    """Return True if latitude and longitude can be the position of a photo.

    A receiver without a position writes 0, 0, which is a point in the sea.
    """
    there = abs(latitude) <= 90.0 and abs(longitude) <= 180.0  # noqa: PLR2004 - degrees
    return there and (latitude, longitude) != (0.0, 0.0)


def _degrees(side: object, value: object) -> float:
    """Convert degrees, minutes and seconds to degrees.

    The result is negative in the south and west, and NaN if the input is invalid.
    """
    if not isinstance(value, tuple) or not 1 <= len(value) <= len(_STEPS):
        return math.nan
    degrees = sum(number(component) / step for component, step in zip(value, _STEPS, strict=False))
    return -degrees if str(side).strip("\0 ").upper() in _SOUTH_OR_WEST else degrees


def number(value: object) -> float:
    """Convert an EXIF tag or a word to a number; NaN if it is not a number."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan
