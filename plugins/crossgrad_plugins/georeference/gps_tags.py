"""Where a photo was taken, by the GPS tags of its EXIF header."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from PIL.Image import Image

#: Latitude and longitude in degrees, and the altitude, each of which may be NaN.
Numbers: TypeAlias = tuple[float, float, float]
_IFD: Final = 0x8825
_SOUTH_OR_WEST: Final = {"S", "W"}
#: EXIF says so of altitudes below the sea, and below the ellipsoid.
_BELOW: Final = {1, 3}
_STEPS: Final = (1.0, 60.0, 3600.0)


def gps_of(image: "Image") -> Numbers:
    """What the tags of a photo say; NaN where they do not, or say no number."""
    tags: Mapping[int, object] = image.getexif().get_ifd(_IFD)
    latitude, longitude = (_degrees(tags.get(side), tags.get(side + 1)) for side in (1, 3))
    below, altitude = tags.get(5), number(tags.get(6))
    if isinstance(below, bytes):
        below = int.from_bytes(below[:1], "big")
    return latitude, longitude, -altitude if below in _BELOW else altitude


def is_place(latitude: float, longitude: float) -> bool:
    """Whether degrees are a place on Earth where photos are taken.

    A receiver without a fix writes 0, 0, which lies in the sea off Ghana.
    """
    there = abs(latitude) <= 90.0 and abs(longitude) <= 180.0  # noqa: PLR2004 - degrees
    return there and (latitude, longitude) != (0.0, 0.0)


def _degrees(side: object, value: object) -> float:
    """Degrees of degrees, minutes and seconds, negative in the south and in the west, or NaN."""
    if not isinstance(value, tuple) or not 1 <= len(value) <= len(_STEPS):
        return math.nan
    degrees = sum(number(part) / step for part, step in zip(value, _STEPS, strict=False))
    return -degrees if str(side).strip("\0 ").upper() in _SOUTH_OR_WEST else degrees


def number(value: object) -> float:
    """The number that a tag or a word is; NaN where it is none."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan
