"""Exposure values of a scene's photos, from their EXIF headers."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from math import isfinite, log2
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from crossgrad_core.plugin import Scene, UserError, View
from crossgrad_core.scene.photos.photos import FilePhoto
from crossgrad_core.scene.photos.pillow import opened

if TYPE_CHECKING:
    from PIL.Image import Image


_IFD = 0x8769
# Tags of ExposureTime, FNumber and ISOSpeedRatings.
_TIME, _APERTURE, _SENSITIVITY = 33434, 33437, 34855
#: Cameras write this ISO value if the sensitivity does not fit into 16 bits.
_OVERFLOW = 65535


def exposure_value(view: View) -> float | None:
    """Return a photo's exposure log2(t ISO / N^2): its brightness at equal light, in stops.

    Args:
        view: The view; its photo need not come from a file.

    Returns:
        The exposure in stops, comparable between photos of one camera. None if the file lacks the
        exposure time t, the sensitivity ISO or the f-number N.
    """
    photo = view.photo
    return _of_file(photo.source.path) if isinstance(photo, FilePhoto) else None


def _of_file(path: Path) -> float | None:
    try:
        with opened(path, "the photo's EXIF header cannot be read") as image:
            return _value(image)
    except UserError:  # If the photo is damaged, decoding reports the error later.
        return None


def _value(image: "Image") -> float | None:
    tags: Mapping[int, object] = image.getexif().get_ifd(_IFD)
    time, aperture, sensitivity = (
        _positive(tags.get(tag)) for tag in (_TIME, _APERTURE, _SENSITIVITY)
    )
    if time is None or aperture is None or sensitivity in {None, _OVERFLOW}:
        return None
    value = log2(time) + log2(sensitivity or 1.0) - 2.0 * log2(aperture)
    return value if isfinite(value) else None


def _positive(value: object) -> float | None:
    """Return the number of a tag; None if it is not a number above 0."""
    first = value[0] if isinstance(value, tuple) and value else value
    try:
        number = float(first)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if isfinite(number) and number > 0.0 else None


#: Number of file headers that are read in parallel.
_AT_ONCE = 4
# Cache of the values, because a run needs them at every evaluation and a scene does not change.
_KNOWN: "WeakKeyDictionary[Scene, Mapping[str, float]]" = WeakKeyDictionary()


def exposure_values(scene: Scene) -> Mapping[str, float]:
    """Return log2(t ISO / N^2) of all photos with EXIF exposure, by name.

    Each scene is read only once.
    """
    by_name = _KNOWN.get(scene)
    if by_name is None:
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            values = list(pool.map(exposure_value, scene.views))
        pairs = zip(scene.views, values, strict=True)
        by_name = _KNOWN[scene] = {view.name: value for view, value in pairs if value is not None}
    return by_name
