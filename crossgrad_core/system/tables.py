"""Tables in CSV files: rows with the union of their columns."""

import csv
import io
from collections.abc import Mapping, Sequence
from math import isnan
from pathlib import Path

from crossgrad_core.system.files import write_atomically


def write_table(path: Path, rows: Sequence[Mapping[str, str | int | float]]) -> None:
    """Writes rows with the union of their columns, in the order in which those occur.

    A number has nine digits; one that is NaN, and a cell that a row lacks, are left empty.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _cell(value) for name, value in row.items()})
    write_atomically(path, text.getvalue().encode())


def _cell(value: float | str) -> str:
    if isinstance(value, float):
        return "" if isnan(value) else f"{value:.9g}"
    return str(value)
