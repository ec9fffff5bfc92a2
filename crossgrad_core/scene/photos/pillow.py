"""Open photo files with Pillow: allowed formats, a pixel limit, and one error type.

HEIC and HEIF files, which phones write, can be read if the package pillow-heif is installed.
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from io import BufferedReader
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from typing_extensions import override

from crossgrad_core.errors import UserError
from crossgrad_core.system.input_files import open_file

if TYPE_CHECKING:
    from PIL.Image import Image


#: Largest number of pixels of a photo. The limit is Pillow's default limit, and an RGB photo of
#: this size needs 0.5 GB.
MOST_PIXELS: Final = 178_956_970
# Formats that cameras and mask tools write. Pillow supports more formats, but some of these formats
# start external programs.
_FORMATS = ("AVIF", "BMP", "GIF", "JPEG", "JPEG2000", "MPO", "PNG", "PPM", "TIFF", "WEBP")
_LOCK = Lock()
_DEEP = re.compile("RGBA?;16[BLN]")
#: Suffixes of HEIC and HEIF files.
SUFFIXES = (".heic", ".heif", ".hif")
#: Number of bytes at the start of a file that identify HEIC and HEIF files.
HEAD = 12
_BRANDS = frozenset(
    {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"}
)


@contextmanager
def opened(path: Path, what: str) -> Iterator["Image"]:
    """Open a photo, but do not decode the photo.

    All errors inside the block are raised as `UserError`.

    Args:
        path: Path of the photo.
        what: The message of the raised error.

    Raises:
        UserError: The file is missing, not a photo, empty, or damaged.
    """
    from PIL import UnidentifiedImageError

    try:
        with _Bounded(path) as file, _identified(file, path) as image:
            _check_pixels(image, path)
            yield image
    except (UserError, MemoryError):
        raise
    except UnidentifiedImageError as error:
        found = "an empty file" if path.stat().st_size == 0 else "an unknown image format"
        raise UserError(
            "the file is not a photo", where=path, found=found, todo="replace or remove the file"
        ) from error
    except Exception as error:
        # Catch all exceptions, because decoders raise errors of any type for damaged files, such as
        # KeyError.
        raise UserError(
            what,
            where=path,
            found=str(error) or type(error).__name__,
            todo="copy or download the file again, or remove it",
        ) from error


class _Bounded(BufferedReader):
    """A file object that never reads more bytes than the file contains.

    A damaged photo may claim any length of a part. For such a part, Python's `read` would allocate
    the claimed number of bytes at once.

    Args:
        path: Path of the file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(open_file(path).detach())
        self._size = os.fstat(self.fileno()).st_size

    @override
    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next `size` bytes; without a number, return all remaining bytes."""
        left = max(0, self._size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def has_alpha(image: "Image") -> bool:
    """Return True if a photo may contain transparent pixels."""
    return "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "RGBa", "La"}


def is_deep(image: "Image") -> bool:
    """Return True if a photo is grey, RGB or RGBA, with 16 bits per channel.

    The photo must not be decoded yet.
    """
    return image.mode.startswith("I") or any(map(_DEEP.fullmatch, _stored_modes(image)))


def take_lower_bytes(image: "Image") -> None:
    """Make Pillow decode the lower byte of each 16-bit colour value instead of the upper byte.

    Pillow has no 16-bit colour modes and decodes only one byte of each value. If `tile` names the
    opposite byte order, Pillow decodes the other byte.
    """
    other = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}
    modes = [mode[:-1] + other[mode[-1]] for mode in _stored_modes(image)]
    file: Any = image  # In Pillow's type annotations, only image files have the attribute `tile`.
    file.tile = [
        (*tile[:3], mode if isinstance(tile[3], str) else (mode, *tile[3][1:]))
        for tile, mode in zip(file.tile, modes, strict=True)
    ]


def _stored_modes(image: "Image") -> list[str]:
    """Return the storage format of each part of a photo, such as `RGB;16B`."""
    arguments = (tile[3] for tile in getattr(image, "tile", ()))
    return [str(args[0] if isinstance(args, tuple) and args else args) for args in arguments]


def rows_of(image: "Image", top: int, end: int) -> bytes:
    """Return the pixels in some rows of an opened photo. The photo is decoded if needed."""
    image.load()
    # Pillow checks its own pixel limit in `crop`, too. Other threads change Pillow's limit for a
    # short time.
    with _LOCK:
        strip = image.crop((0, top, image.width, end))
    return strip.tobytes()


def _check_pixels(image: "Image", path: Path) -> None:
    if 0 in image.size:
        raise UserError("the photo has no pixels", where=path, todo="replace or remove the photo")


def _identified(file: BinaryIO, path: Path) -> "Image":
    """Open an image without Pillow's own pixel limit. crossgrad checks its own limit later."""
    from PIL import Image

    Image.init()
    allowed = (*_FORMATS, "HEIF") if admit(file.read(HEAD), path) else _FORMATS
    file.seek(0)
    formats = [name for name in allowed if name in Image.OPEN]
    # Pillow's limit is a global variable, and several threads open photos at the same time.
    with _LOCK:
        bound, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=formats)
        finally:
            Image.MAX_IMAGE_PIXELS = bound


def admit(head: bytes, path: Path) -> bool:
    """Return True if a file is HEIC or HEIF.

    For a HEIC or HEIF file, the function also enables Pillow to open the file.

    Args:
        head: The first bytes of the file.
        path: Path of the file, for the error message.

    Raises:
        UserError: The file is HEIC or HEIF, and the package pillow-heif is missing.
    """
    if head[4:8] != b"ftyp" or head[8:HEAD] not in _BRANDS:
        return False
    if not _registered():
        raise UserError(
            "photos in HEIC format need a package that is not installed",
            where=path,
            expected="the package pillow-heif",
            todo="pip install 'crossgrad[heic]', or convert the photos to JPEG",
        )
    return True


@cache
def _registered() -> bool:
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    # Use one thread for each photo, because several photos are already decoded at the same time.
    register_heif_opener(thumbnails=False, decode_threads=1)
    return True
