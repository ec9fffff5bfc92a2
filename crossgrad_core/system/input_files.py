"""Reading of input files.

Only regular files of limited size are read, so that reading neither blocks nor fills the memory.
Symbolic links are followed. docs/reliability.md lists the locations to which file names may point.
"""

import os
import stat
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path
from typing import Final

from crossgrad_core.system.files import size_text

#: Maximum number of bytes of a file that is parsed as a whole. The parsed values may take `GROWS`
#: times as much memory.
LARGEST: Final = 64 << 20
GROWS: Final = 8
#: Number of bytes per character of Python's widest strings.
_WIDEST: Final = 4


def is_file(path: Path) -> bool:
    """Return True for a regular file or a link to a regular file; False if the name is too long."""
    try:
        return path.is_file()
    except OSError:
        return False


def open_file(path: Path) -> BufferedReader:
    """Open a file for reading.

    Raises:
        OSError: The file cannot be opened, or it is a pipe or a device, which might never open or
            end.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("a folder, pipe or device instead of a file")
    return path.open("rb")


def read_file(path: Path, weights: Mapping[bytes, int] | None = None, most: int = LARGEST) -> bytes:
    """Return the content of a file that is parsed as a whole.

    Args:
        path: The file.
        weights: Character -> bytes of memory that each occurrence of the character adds to the
            parsed values.
        most: Maximum size of the file in bytes; the parsed values may take `GROWS` times as much
            memory.

    Raises:
        OSError: The file, or its values in memory, would be too large; see also `open_file`.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise OSError(f"{size_text(size)}, more than the limit of {size_text(most)}")
        content = file.read(size)
    held = len(content) * (1 if content.isascii() else _WIDEST)
    held += sum(weight * content.count(sign) for sign, weight in (weights or {}).items())
    if held > GROWS * most:
        raise OSError(
            f"values that need {size_text(held)} in memory, more than the limit of "
            f"{size_text(GROWS * most)}"
        )
    return content
