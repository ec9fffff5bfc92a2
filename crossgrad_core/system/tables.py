"""Tables in CSV files."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from math import isnan
from pathlib import Path

from crossgrad_core.system.files import text_bytes, write_atomically


def write_table(path: Path, rows: Sequence[Mapping[str, str | int | float]]) -> None:
    """Writes rows with the union of their columns, in the order in which those occur.

    A number has nine digits; one that is NaN, and a cell that a row lacks, are left empty.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    write_atomically(path, table_bytes(rows))


def table_bytes(rows: Sequence[Mapping[str, str | int | float]]) -> bytes:
    """What `write_table` writes."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = ([_rounded(row.get(name)) for name in columns] for row in rows)
    return csv_bytes([columns, *lines])


def csv_bytes(lines: Iterable[Iterable[str]]) -> bytes:
    """Lines of cells as they stand in a file: UTF-8, commas, a line feed behind each line."""
    rows = _Rows()
    # With this line end both of its signs are quoted in a cell.
    csv.writer(rows, lineterminator="\r\n").writerows(lines)
    return text_bytes("".join(row.removesuffix("\r\n") + "\n" for row in rows))


class _Rows(list[str]):
    """The rows that a `csv.writer` writes, one by one."""

    def write(self, row: str) -> None:
        self.append(row)


def as_cell(value: float | str | None) -> str:
    """A value with all its digits; an empty cell where there is none."""
    return "" if value is None else str(value)


def _rounded(value: float | str | None) -> str:
    if isinstance(value, float):
        return "" if isnan(value) else f"{value:.9g}"
    return as_cell(value)
