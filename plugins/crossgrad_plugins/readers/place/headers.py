"""Where photos were taken, by the GPS in their EXIF headers."""

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
    """Where photos were taken.

    Attributes:
        source: What tells it.
        places: Name of a photo -> its place.
        flat: Number of photos of which all but the altitude is known, beside those.
        strangers: Names that are those of no photo.
    """

    source: str
    places: "Mapping[str, Place]" = field(default_factory=dict)
    flat: int = 0
    strangers: tuple[str, ...] = ()


def of_headers(files: Mapping[str, Path], source: str) -> Measured:
    """The places in the EXIF headers of photos; those that have none are left out.

    Args:
        files: Name -> file; one that is not there, or is no photo, tells nothing.
        source: What the photos are called.
    """
    return measured(((name, _header(path)) for name, path in files.items()), source)


def measured(found: Iterable[tuple[str, Numbers | None]], source: str) -> Measured:
    """What is a place on Earth among numbers of photos."""
    known: dict[str, Numbers] = {}
    flat = 0
    for name, numbers in found:
        if numbers is None or not is_place(*numbers[:2]):
            continue
        if math.isfinite(numbers[2]):
            known[name] = numbers
        else:
            flat += 1
    if not known:
        return Measured(source, flat=flat)
    from crossgrad_plugins.georeference.ellipsoid import Place

    return Measured(source, {name: Place(*numbers) for name, numbers in known.items()}, flat)


def _header(path: Path) -> Numbers | None:
    if not is_file(path):
        return None
    try:
        with opened(path, "the photo's EXIF header cannot be read") as image:
            return gps_of(image)
    except UserError:  # Decoding the photo raises it again, if it is one of the photo.
        return None
