"""The first bytes of files, and the header of a table: line, separator, columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

_DELIMITERS: Final = (",", ";", "\t")
_HEAD: Final = 1 << 16


@dataclass(frozen=True)
class Columns:
    """The columns of a table.

    Attributes:
        names: In lower case, without a `#` before the first one.
        delimiter: The sign between two cells.
    """

    names: tuple[str, ...]
    delimiter: str

    @classmethod
    def of(cls, path: Path, known: frozenset[str]) -> "Columns":
        """The columns of a file: of the line among its first ones with most of the known names.

        Comments may come before that line.
        """
        head = head_of(path)
        wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
        text = head.decode("utf-16" if wide else "utf-8", "replace")
        tables = (cls(column_names(line.split(sign)), sign)
                  for line in text.splitlines() for sign in _DELIMITERS)  # fmt: skip
        return max(tables, key=lambda each: len(known & {*each.names}), default=cls((), ","))


def column_names(cells: list[str]) -> tuple[str, ...]:
    """The names of columns in the cells of a header, without empty ones at the end."""
    names = [cell.strip(' "\r\ufeff').lstrip("#").strip().lower() for cell in cells]
    while names and not names[-1]:
        names.pop()
    return tuple(names)


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
