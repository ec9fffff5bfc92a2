"""Looks at the first bytes of files, to tell formats apart without reading them."""

from pathlib import Path
from typing import Final

_HEAD: Final = 1 << 16


def head_of(path: Path) -> bytes:
    """The first bytes of a file; none where there is no such file, or it may not be read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(_HEAD)
    except (OSError, ValueError):
        return b""


def begins_with(path: Path, sign: bytes) -> bool:
    """Whether a file begins with a sign, but for spaces and a byte order mark."""
    return head_of(path).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(sign)


def holds(path: Path, piece: bytes) -> bool:
    """Whether a piece stands among the first bytes of a file."""
    return piece in head_of(path)
