"""per_view.csv: the metrics of every held-out view."""

import csv
import io
from pathlib import Path

from crossgrad_core.evaluation.result import EvaluationResult
from crossgrad_core.system.files import write_atomically

FILE = "per_view.csv"


def write_per_view(folder: Path, result: EvaluationResult, name: str = FILE) -> None:
    """Writes one line per view: name, regime, metrics; an empty cell where one is not known.

    Raises:
        UserError: The disk is full.
    """
    text = io.StringIO()
    columns = ["name", "regime", *(figure.name for figure in result.figures)]
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(
        {"name": view.name, "regime": view.regime, **view.values} for view in result.views
    )
    write_atomically(folder / name, text.getvalue().encode())
