"""CSV and JSON files, read so that whatever is in them ends in rows and values or in one error."""

import csv
import io
import json
import re
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.system.input_files import LARGEST, read_file

# `int` and `float` also take digits of other scripts, digit groups and spaces.
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf|nan", re.ASCII)
_LONGEST_NUMBER = 400
# Bytes of a list, a cell, an object with one member, and of a value with its place or key.
_CSV = {b"\n": 160, b"\r": 160, b",": 60}
_JSON = {b"[": 96, b"{": 240, b",": 64, b":": 64}


def read_rows(
    path: Path, what: str, todo: str, *, whole: bool = False, delimiter: str = ","
) -> list[list[str]]:
    """The rows of a CSV file in UTF-8; empty lines are rows without cells.

    Args:
        path: The file.
        what: What cannot be read, should it be so, such as `the list of labels`.
        todo: What to do about it.
        whole: Leave out a last line that has no end.
        delimiter: The sign between two cells.

    Raises:
        UserError: The file is missing or is not CSV, or too large.
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
    """The value in a JSON file in UTF-8, with or without a byte order mark.

    Args:
        path: The file.
        most: Bytes that it may have.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, is too large or too deep, or is not JSON.
    """
    try:
        value: object = json.loads(read_file(path, _JSON, most).decode("utf-8-sig"))
    except RecursionError as error:
        raise ValueError("lists or objects within each other without an end") from error
    except FileNotFoundError as error:
        raise FileNotFoundError("there is no such file") from error
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error
    return value


def parse_number(text: str) -> int | float:
    """A whole number as int, any other as float.

    Raises:
        ValueError: The text is no number, or has more digits than one can have.
    """
    if len(text) > _LONGEST_NUMBER or not _NUMBER.fullmatch(text):
        raise ValueError(f"not a number: {text!r}")
    try:
        return int(text)
    except ValueError:
        return float(text)
