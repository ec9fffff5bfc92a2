"""EXIF headers: the camera of a photo, and the place where it was taken."""

from math import isfinite
from typing import TYPE_CHECKING, Final

from crossgrad_plugins.georeference.gps_tags import gps_of, is_place
from crossgrad_plugins.prepare.plan import Position

if TYPE_CHECKING:
    from PIL.Image import Image

_EXIF, _ORIENTATION = 0x8769, 0x0112
_ORIENTATIONS: Final = range(1, 9)
_MAKE, _MODEL, _FOCAL, _FOCAL_35 = 0x010F, 0x0110, 0x920A, 0xA405


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
    """Where the photo was taken; None where it does not say, or says what no place is."""
    latitude, longitude, altitude = gps_of(image)
    if not is_place(latitude, longitude) or not isfinite(altitude):
        return None
    return Position(latitude=latitude, longitude=longitude, altitude=altitude)


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if isfinite(number) else None
