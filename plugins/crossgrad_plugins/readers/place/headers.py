"""GPS positions of photos from their EXIF headers."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crossgrad_core.plugin import UserError, is_file
from crossgrad_core.scene.photos.pillow import opened
from crossgrad_plugins.georeference.gps_tags import Numbers, gps_of, is_place

if TYPE_CHECKING:
    from crossgrad_plugins.georeference.ellipsoid import Place


@dataclass(frozen=True)
class Measured:
    """Positions at which photos were taken.

    Attributes:
        source: Source of the positions, for messages.
        places: Name of a photo -> its position.
        flat: Number of further photos that have a position but no altitude.
        strangers: Names in the source that match no photo.
    """

    source: str
    places: "Mapping[str, Place]" = field(default_factory=dict)
    flat: int = 0
    strangers: tuple[str, ...] = ()


def of_headers(files: Mapping[str, Path], source: str) -> Measured:
    """Return the positions from the EXIF headers of photos. Photos without a position are left out.

    Args:
        files: Name of a photo -> its file. Missing files and files that are not photos are ignored.
        source: Description of the photos, for messages.
    """
    return measured(((name, _header(path)) for name, path in files.items()), source)


def measured(found: Iterable[tuple[str, Numbers | None]], source: str) -> Measured:
    """Return the valid positions among the GPS numbers of photos."""
    valid: dict[str, Numbers] = {}
    flat = 0
    for name, numbers in found:
        if numbers is None or not is_place(*numbers[:2]):
            continue
        if math.isfinite(numbers[2]):
            valid[name] = numbers
        else:
            flat += 1
    if not valid:
        return Measured(source, flat=flat)
    from crossgrad_plugins.georeference.ellipsoid import Place

    return Measured(source, {name: Place(*numbers) for name, numbers in valid.items()}, flat)


def _header(path: Path) -> Numbers | None:
    if not is_file(path):
        return None
    try:
        with opened(path, "the photo's EXIF header cannot be read") as image:
            return gps_of(image)
    except UserError:  # If the run uses this photo, decoding reports the error.
        return None
