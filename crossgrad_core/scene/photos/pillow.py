"""Photo files through Pillow: allowed formats, pixel limit, and one error type for all faults.

HEIC and HEIF, the formats of phones, are read if the package pillow-heif is installed.
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


#: Maximum number of pixels that are decoded at once: Pillow's default limit, 0.5 GB of RGB.
MOST_PIXELS: Final = 178_956_970
# Formats of cameras and mask tools. Pillow knows more formats, some of which run programs.
_FORMATS = ("AVIF", "BMP", "GIF", "JPEG", "JPEG2000", "MPO", "PNG", "PPM", "TIFF", "WEBP")
_LOCK = Lock()
_DEEP = re.compile("RGBA?;16[BLN]")
#: Suffixes of HEIC and HEIF files.
SUFFIXES = (".heic", ".heif", ".hif")
#: Number of bytes at the start of a file that identify a HEIC or HEIF file.
HEAD = 12
_BRANDS = frozenset(
    {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"}
)


@contextmanager
def opened(path: Path, what: str) -> Iterator["Image"]:
    """Open a photo without decoding it; every error inside the block becomes one `UserError`.

    Args:
        path: The file.
        what: The message of the error.

    Raises:
        UserError: The file is missing, not a photo, without pixels, or damaged.
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
        # Catch every exception, because decoders raise any type for damaged files: KeyError,
        # struct.error ...
        raise UserError(
            what,
            where=path,
            found=str(error) or type(error).__name__,
            todo="copy or download the file again, or remove it",
        ) from error


class _Bounded(BufferedReader):
    """A file that never returns more bytes than it contains.

    A chunk may claim any length, and a plain `read` would allocate that much memory at once.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(open_file(path).detach())
        self._size = os.fstat(self.fileno()).st_size

    @override
    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes, or all remaining bytes if no number is given."""
        left = max(0, self._size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def has_alpha(image: "Image") -> bool:
    """Return True if pixels of a photo may be transparent."""
    return "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "RGBa", "La"}


def is_deep(image: "Image") -> bool:
    """Return True if an undecoded photo is grey, RGB or RGBA with 16 bits per channel."""
    return image.mode.startswith("I") or any(map(_DEEP.fullmatch, _stored_modes(image)))


def take_lower_bytes(image: "Image") -> None:
    """Make Pillow decode the lower bytes of a 16-bit colour photo, not the upper bytes.

    Pillow has no 16-bit colour modes. The function reads the other byte if the byte order is
    swapped.
    """
    other = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}
    modes = [mode[:-1] + other[mode[-1]] for mode in _stored_modes(image)]
    file: Any = image  # Pillow's types define `tile` only for opened files.
    file.tile = [
        (*tile[:3], mode if isinstance(tile[3], str) else (mode, *tile[3][1:]))
        for tile, mode in zip(file.tile, modes, strict=True)
    ]


def _stored_modes(image: "Image") -> list[str]:
    """Return how the pixels of each part of a photo are stored, such as `RGB;16B`."""
    arguments = (tile[3] for tile in getattr(image, "tile", ()))
    return [str(args[0] if isinstance(args, tuple) and args else args) for args in arguments]


def rows_of(image: "Image", top: int, end: int) -> bytes:
    """Return the pixels of some rows of an opened photo; decodes the photo if needed."""
    image.load()
    with _LOCK:  # Pillow checks its pixel limit here, too.
        strip = image.crop((0, top, image.width, end))
    return strip.tobytes()


def _check_pixels(image: "Image", path: Path) -> None:
    if 0 in image.size:
        raise UserError("the photo has no pixels", where=path, todo="replace or remove the photo")


def _identified(file: BinaryIO, path: Path) -> "Image":
    """Open an image without Pillow's pixel limit; crossgrad checks its own limit later."""
    from PIL import Image

    Image.init()
    allowed = (*_FORMATS, "HEIF") if admit(file.read(HEAD), path) else _FORMATS
    file.seek(0)
    formats = [name for name in allowed if name in Image.OPEN]
    with _LOCK:  # Pillow's limit is a global variable, and photos are decoded in several threads.
        bound, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=formats)
        finally:
            Image.MAX_IMAGE_PIXELS = bound


def admit(head: bytes, path: Path) -> bool:
    """Return True if a file is HEIC or HEIF; afterwards Pillow can open it.

    Args:
        head: The first bytes of the file.
        path: The file.

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
    # Use one thread here, because photos are already decoded in several threads.
    register_heif_opener(thumbnails=False, decode_threads=1)
    return True
