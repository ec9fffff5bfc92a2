"""The first bytes of a file, and the header of a table: its line, separator and column names."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

_DELIMITERS: Final = (",", ";", "\t")
_HEAD: Final = 1 << 16


@dataclass(frozen=True)
class Columns:
    """The columns of a table.

    Attributes:
        names: Column names in lower case, without a `#` before the first name.
        delimiter: The separator between two cells.
    """

    names: tuple[str, ...]
    delimiter: str

    @classmethod
    def of(cls, path: Path, known: frozenset[str]) -> "Columns":
        """Return the columns of a file.

        The header is the line that contains most of the known names. Only the first bytes of the
        file are searched. Comments may precede the header line.
        """
        head = head_of(path)
        wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
        text = head.decode("utf-16" if wide else "utf-8", "replace")
        tables = (cls(column_names(line.split(sign)), sign)
                  for line in text.splitlines() for sign in _DELIMITERS)  # fmt: skip
        return max(tables, key=lambda table: len(known & {*table.names}), default=cls((), ","))


def column_names(cells: list[str]) -> tuple[str, ...]:
    """Return the column names in a header, without empty names at the end."""
    names = [cell.strip(' "\r\ufeff').lstrip("#").strip().lower() for cell in cells]
    while names and not names[-1]:
        names.pop()
    return tuple(names)


def head_of(path: Path) -> bytes:
    """Return the first bytes of a file; none if the file is missing or unreadable."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(_HEAD)
    except (OSError, ValueError):
        return b""


def begins_with(path: Path, sign: bytes) -> bool:
    """Return True if a file begins with `sign`; a byte order mark and spaces are skipped."""
    return head_of(path).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(sign)


def holds(path: Path, piece: bytes) -> bool:
    """Return True if the first bytes of a file contain `piece`."""
    return piece in head_of(path)
