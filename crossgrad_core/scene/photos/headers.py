"""Read the size and kind of photos from their headers, and detect truncated files."""

from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.pillow import has_alpha, is_deep, opened

if TYPE_CHECKING:
    from PIL.Image import Image

_TAIL = 64
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", 0xDA, b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG", b"IEND\xaeB`\x82"
_PNG_DEPTH, _PNG_CHANNELS = 24, {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_JPEG_PIXELS_PER_BYTE = 8 * 64
_DEFLATE_RATIO = 1032  # Maximum compression factor of deflate, https://zlib.net/zlib_tech.html
_ORIENTATION = 0x0112
_QUARTER_TURNS = range(5, 9)
# Tags of the offsets and byte counts of strips, and of tiles.
_TIFF_DATA = ((273, 279), (324, 325))


@dataclass(frozen=True)
class PhotoHeader:
    """The size and kind of a photo's pixels as stored, before any EXIF rotation.

    Attributes:
        width: Width in pixels.
        height: Height in pixels.
        alpha: True if pixels may be transparent.
        grey: True if the photo contains no colours.
        reducible: True if the photo can be decoded at a reduced size with less memory.
        deep: True if the photo is grey, RGB or RGBA, with 16 bits per channel.
    """

    width: int
    height: int
    alpha: bool
    grey: bool
    reducible: bool = False
    deep: bool = False

    def reduced(self, by: int) -> "PhotoHeader":
        """Return the header for a photo that is decoded with both sides divided by `by`."""
        return replace(self, width=-(-self.width // by), height=-(-self.height // by))


def read_header(path: Path) -> PhotoHeader:
    """Read the header of a photo. Check without decoding that the file is not truncated.

    Raises:
        UserError: The file is not a readable photo, or the end of the file is missing.
    """
    with opened(path, "the photo cannot be read") as image, path.open("rb") as file:
        size = path.stat().st_size
        whole = _is_whole(file) and _has_all_tiff_data(image, size)
        if not whole or image.width * image.height > _most_pixels(image, file, size):
            raise UserError(
                "the photo is incomplete: the end of the file is missing",
                where=path,
                expected=f"{image.width} x {image.height} pixels",
                found=f"{size:,} bytes",
                todo="copy or download the photo again, or remove it",
            )
        return _describe(image)


def read_quarter_turn(path: Path) -> int | None:
    """Return the EXIF orientation of a photo if it swaps width and height (5 to 8); otherwise None.

    Raises:
        UserError: The EXIF header of the photo is damaged.
    """
    with opened(path, "the photo's EXIF header cannot be read") as image:
        orientation = image.getexif().get(_ORIENTATION)
    return next((turn for turn in _QUARTER_TURNS if turn == orientation), None)


def _describe(image: "Image") -> PhotoHeader:
    grey = image.mode in {"1", "L", "LA", "La", "F"} or image.mode.startswith("I")
    reducible = image.format in {"JPEG", "MPO"} and not image.info.get("progressive")
    return PhotoHeader(
        *(image.width, image.height, has_alpha(image), grey, reducible, is_deep(image))
    )


def _most_pixels(image: "Image", file: BinaryIO, size: int) -> float:
    """Return the largest number of pixels that a file of `size` bytes can contain.

    Return inf for formats without a known limit.

    If a header claims more pixels, the decoder would allocate memory for pixels that the file does
    not contain.
    """
    if image.format in {"JPEG", "MPO"}:
        # A JPEG file needs at least one bit for each block of 8 x 8 pixels: the Huffman code of the
        # block's mean.
        return _JPEG_PIXELS_PER_BYTE * size
    if image.format == "PNG":
        file.seek(_PNG_DEPTH)
        depth, colors = file.read(2)
        return _DEFLATE_RATIO * size * 8 / (depth * _PNG_CHANNELS[colors])
    return inf


def _is_whole(file: BinaryIO) -> bool:
    """Return True if a JPEG, PNG or WebP file is complete.

    The file position is reset to the start.
    """
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
    """Return True if an end marker follows the first scan. Data after the photo are allowed.

    The thumbnail in the EXIF header has its own end marker, which this function ignores.
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
