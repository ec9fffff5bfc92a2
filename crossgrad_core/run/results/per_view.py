"""per_view.csv: the metrics of every held-out view."""

from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.tables import as_cell, csv_bytes
from crossgrad_core.system.text_files import parse_number, read_rows

FILE = "per_view.csv"
_NAMES = ("name", "regime")
_TODO = "restore the file, or write it again: crossgrad eval RUN"


def write_per_view(folder: Path, result: EvaluationResult, name: str = FILE) -> None:
    """Writes one line per view: name, regime, metrics; an empty cell where one is not known.

    Raises:
        UserError: The disk is full.
    """
    figures = [figure.name for figure in result.figures]
    lines = (
        [view.name, view.regime, *(as_cell(view.values[each]) for each in figures)]
        for view in result.views
    )
    write_atomically(folder / name, csv_bytes([[*_NAMES, *figures], *lines]))


def read_per_view(folder: Path) -> tuple[ViewMetrics, ...]:
    """The figures of every held-out view of a run, in the order of the scene.

    Returns:
        The views; none where there is no such file, as before the first evaluation.

    Raises:
        UserError: The file is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return ()
    header, *lines = read_rows(path, FILE, _TODO) or [[]]
    if tuple(header[:2]) != _NAMES or len(set(header)) < len(header):
        expected = f"a first line that begins with {','.join(_NAMES)}"
        raise _unreadable(path, ",".join(header) or "an empty file", expected)
    return tuple(_view(path, header, line) for line in lines)


def _view(path: Path, header: list[str], line: list[str]) -> ViewMetrics:
    if len(line) != len(header):
        expected = f"{len(header)} cells in each line"
        raise _unreadable(path, f"{len(line)}: {','.join(line)}", expected)
    try:
        cells = dict(zip(header[2:], line[2:], strict=True))
        values = {name: float(parse_number(cell)) if cell else None for name, cell in cells.items()}
        name, regime = line[:2]
    except (ValueError, OverflowError) as error:
        raise _unreadable(path, str(error)) from error
    return ViewMetrics(name, regime, values)


def _unreadable(path: Path, found: str, expected: str = "") -> UserError:
    return UserError(f"unreadable {FILE}", where=path, expected=expected, found=found, todo=_TODO)
