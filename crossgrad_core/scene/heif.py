"""HEIC and HEIF, what phones write: through the package pillow-heif where it is installed."""

from functools import cache
from pathlib import Path

from crossgrad_core.errors import UserError

#: What the names of such files end in.
SUFFIXES = (".heic", ".heif", ".hif")
#: Bytes of a file that tell.
HEAD = 12
_BRANDS = frozenset(
    {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"}
)


def admit(head: bytes, path: Path) -> bool:
    """Whether a file is of this kind; if so, Pillow can open it from now on.

    Args:
        head: Its first bytes.
        path: The file.

    Raises:
        UserError: It is, and the package is missing.
    """
    if head[4:8] != b"ftyp" or head[8:HEAD] not in _BRANDS:
        return False
    if not _registered():
        raise UserError(
            "photos in HEIC need a package that is not installed",
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
    # Photos are decoded in threads already.
    register_heif_opener(thumbnails=False, decode_threads=1)
    return True
