"""What a photo file says about itself without being decoded, and whether it is whole."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from crossgrad_core.errors import UserError

if TYPE_CHECKING:
    from PIL.Image import Image

_TAIL = 64
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", 0xDA, b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG", b"IEND\xaeB`\x82"
_ORIENTATION = 0x0112
_QUARTER_TURNS = range(5, 9)
_TIFF_DATA = ((273, 279), (324, 325))  # offsets and byte counts of strips and of tiles


@dataclass(frozen=True)
class PhotoHeader:
    """Size of the stored pixel grid, before any EXIF rotation, and whether there is transparency.

    Attributes:
        width: Pixels.
        height: Pixels.
        alpha: Whether pixels may be transparent.
        grey: Whether the photo has no colour.
    """

    width: int
    height: int
    alpha: bool
    grey: bool


def read_header(path: Path) -> PhotoHeader:
    """Reads the header of a photo and checks cheaply that the file was not cut short.

    Raises:
        UserError: Not a readable photo, or its end is missing.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with path.open("rb") as file:
            whole = _is_whole(file)
            with Image.open(file) as image:
                whole = whole and _has_all_tiff_data(image, path.stat().st_size)
                header = _describe(image)
    except UnidentifiedImageError as error:
        found = "an empty file" if path.stat().st_size == 0 else "no format that Pillow knows"
        raise UserError(
            "the file is not a photo", where=path, found=found, todo="replace or remove it"
        ) from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(
            "the photo cannot be read",
            where=path,
            found=str(error),
            todo="check its permissions, copy or download it again, or remove it",
        ) from error
    if not whole:
        raise UserError(
            "the photo is cut short: the end of the file is missing",
            where=path,
            todo="copy or download it again, or remove it",
        )
    return header


def read_quarter_turn(path: Path) -> int | None:
    """The EXIF orientation of a photo, if it swaps width and height (5 to 8)."""
    from PIL import Image

    with Image.open(path) as image:
        orientation = int(image.getexif().get(_ORIENTATION, 1))
    return orientation if orientation in _QUARTER_TURNS else None


def _describe(image: "Image") -> PhotoHeader:
    alpha = "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "RGBa", "La"}
    grey = image.mode in {"1", "L", "LA", "La", "F"} or image.mode.startswith("I")
    return PhotoHeader(image.width, image.height, alpha, grey)


def _is_whole(file: BinaryIO) -> bool:
    """Whether JPEG, PNG and WebP files have their end; leaves the file at its start."""
    head = file.read(12)
    size = file.seek(0, 2)
    file.seek(max(0, size - _TAIL))
    tail = file.read()
    file.seek(0)
    if head.startswith(_JPEG_START):
        return tail.rstrip(b"\0").endswith(_JPEG_END) or _has_jpeg_end(file)
    if head.startswith(_PNG_START):
        return _PNG_END in tail
    if head.startswith(b"RIFF") and head.endswith(b"WEBP"):
        return int.from_bytes(head[4:8], "little") + 8 <= size
    return True


def _has_jpeg_end(file: BinaryIO) -> bool:
    """Whether an end marker follows the first scan: data behind the photo is allowed.

    The thumbnail within the EXIF header has an end marker of its own, which does not count.
    """
    data = file.read()
    file.seek(0)
    at = len(_JPEG_START)
    while at + 4 <= len(data) and data[at] == _JPEG_END[0]:
        if data[at + 1] == _JPEG_SCAN:
            return data.find(_JPEG_END, at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _has_all_tiff_data(image: "Image", size: int) -> bool:
    tags = getattr(image, "tag_v2", {})
    for offsets, counts in _TIFF_DATA:
        ends = zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)
        if any(offset + length > size for offset, length in ends):
            return False
    return True
