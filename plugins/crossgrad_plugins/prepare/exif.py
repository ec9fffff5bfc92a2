"""EXIF headers: the camera of a photo, and the place where it was taken."""

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Final

from crossgrad_plugins.prepare.plan import Position

if TYPE_CHECKING:
    from PIL.Image import Image

_EXIF, _GPS, _ORIENTATION = 0x8769, 0x8825, 0x0112
_ORIENTATIONS: Final = range(1, 9)
_MAKE, _MODEL, _FOCAL, _FOCAL_35 = 0x010F, 0x0110, 0x920A, 0xA405
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_BELOW_SEA: Final = (1, b"\x01")
_DEGREES: Final = {"latitude": 90.0, "longitude": 180.0}
_PER_PART: Final = (1.0, 60.0, 3600.0)


def camera_of(image: "Image") -> str:
    """Make, model and focal length, as the photo says; photos of one zoom agree."""
    header = image.getexif()
    details = header.get_ifd(_EXIF)
    parts = [header.get(_MAKE), header.get(_MODEL), _number(details.get(_FOCAL)),
             _number(details.get(_FOCAL_35))]  # fmt: skip
    return " ".join(str(part).strip("\0 ") for part in parts if part is not None)


def orientation_of(image: "Image") -> int:
    """How the photo is turned when it is shown, 1 to 8; 1 where it does not say."""
    found = image.getexif().get(_ORIENTATION)
    return found if isinstance(found, int) and found in _ORIENTATIONS else 1


def position_of(image: "Image") -> Position | None:
    """Where the photo was taken; None where it does not say, or says what no place is.

    A receiver without a fix writes 0, 0, which lies in the sea off Ghana.
    """
    tags: Mapping[int, object] = image.getexif().get_ifd(_GPS)
    latitude = _angle(tags.get(_LATITUDE), tags.get(_LATITUDE_REF), "S")
    longitude = _angle(tags.get(_LONGITUDE), tags.get(_LONGITUDE_REF), "W")
    altitude = _number(tags.get(_ALTITUDE))
    if latitude is None or longitude is None or altitude is None or not (latitude or longitude):
        return None
    if abs(latitude) > _DEGREES["latitude"] or abs(longitude) > _DEGREES["longitude"]:
        return None
    if tags.get(_ALTITUDE_REF) in _BELOW_SEA:
        altitude = -altitude
    return Position(latitude=latitude, longitude=longitude, altitude=altitude)


def _angle(value: object, reference: object, negative: str) -> float | None:
    """Degrees from degrees, minutes and seconds."""
    if not isinstance(value, tuple):
        return None
    parts = [_number(part) for part in value]
    known = [part for part in parts if part is not None]
    if len(known) != len(parts) or not 1 <= len(known) <= len(_PER_PART):
        return None
    degrees = sum(part / per for part, per in zip(known, _PER_PART, strict=False))
    return -degrees if str(reference).strip("\0 ").upper().startswith(negative) else degrees


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if isfinite(number) else None
