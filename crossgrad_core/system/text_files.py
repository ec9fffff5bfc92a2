"""Functions that read CSV and JSON files and write CSV tables."""

import csv
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from math import isnan
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import text_bytes, write_atomically
from crossgrad_core.system.input_files import LARGEST, read_file

# Check numbers with a pattern, because `int` and `float` also accept digits of other scripts, digit
# groups and spaces.
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf|nan", re.ASCII)
_LONGEST_NUMBER = 400
# Estimated bytes of memory for each of these characters in a file. In CSV, each line end stands for
# a list, and each comma for a cell. In JSON, each `[` stands for a list, each `{` for an object,
# and each `,` or `:` for a value.
_CSV = {b"\n": 160, b"\r": 160, b",": 60}
_JSON = {b"[": 96, b"{": 240, b",": 64, b":": 64}


def read_rows(
    path: Path, what: str, todo: str, *, whole: bool = False, delimiter: str = ","
) -> list[list[str]]:
    """Return the rows of a CSV file in UTF-8; empty lines are rows without cells.

    Args:
        path: The file.
        what: Name of the content for an error message, such as `the list of labels`.
        todo: Advice for an error message.
        whole: True to leave out a last line without a line end.
        delimiter: The character between two cells.

    Raises:
        UserError: The file is missing, is not CSV, or is too large.
    """
    try:
        content = read_file(path, {**_CSV, delimiter.encode(): _CSV[b","]})
        text = (content[: content.rfind(b"\n") + 1] if whole else content).decode("utf-8-sig")
        lines = io.StringIO(text, newline="")
        return list(csv.reader(lines, delimiter=delimiter, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        found = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{what} cannot be read", where=path, found=found, todo=todo) from error


def read_json(path: Path, most: int = LARGEST) -> object:
    """Return the value in a JSON file in UTF-8, with or without a byte order mark.

    Args:
        path: The file.
        most: Maximum size of the file in bytes.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, is too large or too deeply nested, or is not JSON.
    """
    try:
        value: object = json.loads(read_file(path, _JSON, most).decode("utf-8-sig"))
    except RecursionError as error:
        raise ValueError("lists or objects are nested too deeply") from error
    except FileNotFoundError as error:
        raise FileNotFoundError("the file does not exist") from error
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error
    return value


def parse_number(text: str) -> int | float:
    """Return the number in a text as int if it is a whole number, else as float.

    Raises:
        ValueError: The text is not a number, or has too many digits.
    """
    if len(text) > _LONGEST_NUMBER or not _NUMBER.fullmatch(text):
        raise ValueError(f"not a number: {text!r}")
    try:
        return int(text)
    except ValueError:
        return float(text)


def write_table(path: Path, rows: Sequence[Mapping[str, str | int | float]]) -> None:
    """Write rows as a CSV table with all columns of the rows, in the order of first occurrence.

    Floating-point numbers have nine significant digits. NaN and missing cells become empty cells.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    write_atomically(path, table_bytes(rows))


def table_bytes(rows: Sequence[Mapping[str, str | int | float]]) -> bytes:
    """Return the bytes that `write_table` writes."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = ([_rounded(row.get(name)) for name in columns] for row in rows)
    return csv_bytes([columns, *lines])


def csv_bytes(lines: Iterable[Iterable[str]]) -> bytes:
    """Return lines of cells as CSV bytes: UTF-8, commas, and a line feed after each line."""
    rows = _Rows()
    # With this line end, the writer quotes cells that contain a carriage return or a line feed.
    csv.writer(rows, lineterminator="\r\n").writerows(lines)
    return text_bytes("".join(row.removesuffix("\r\n") + "\n" for row in rows))


class _Rows(list[str]):
    """A list of the rows that a `csv.writer` writes."""

    def write(self, row: str) -> None:
        self.append(row)


def as_cell(value: float | str | None) -> str:
    """Return the text of a CSV cell: a value with all its digits, or nothing for None."""
    return "" if value is None else str(value)


def _rounded(value: float | str | None) -> str:
    if isinstance(value, float):
        return "" if isnan(value) else f"{value:.9g}"
    return as_cell(value)
