"""Files from outside: regular ones only, of bounded size, so that none blocks or fills the memory.

Links are followed; docs/reliability.md says which names may lead where.
"""

import os
import stat
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path
from typing import Final

from crossgrad_core.system.files import size_text

#: Bytes of a file that is parsed as a whole. What Python makes of it may take some times as many.
LARGEST: Final = 64 << 20
GROWS: Final = 8
#: Bytes of a character in Python's widest texts.
_WIDEST: Final = 4


def is_file(path: Path) -> bool:
    """Whether there is a regular file, or a link to one; no file has a name that is too long."""
    try:
        return path.is_file()
    except OSError:
        return False


def open_file(path: Path) -> BufferedReader:
    """Opens a file to be read.

    Raises:
        OSError: It cannot be, or is a pipe or a device, which might never open or end.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("a folder, pipe or device in place of a file")
    return path.open("rb")


def read_file(path: Path, weights: Mapping[bytes, int] | None = None, most: int = LARGEST) -> bytes:
    """The content of a file that is parsed as a whole.

    Args:
        path: The file.
        weights: Sign -> bytes of memory that go into what one of it stands for.
        most: Bytes that it may have; values may take `GROWS` times as many in memory.

    Raises:
        OSError: See `open_file`; or it is too large, or would become too large.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise OSError(f"{size_text(size)}, more than {size_text(most)}")
        content = file.read(size)
    held = len(content) * (1 if content.isascii() else _WIDEST)
    held += sum(weight * content.count(sign) for sign, weight in (weights or {}).items())
    if held > GROWS * most:
        raise OSError(f"values of {size_text(held)} in memory, more than {size_text(GROWS * most)}")
    return content
