"""metrics.csv, which contains one row per evaluation; each row is written to disk immediately."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

from crossgrad_core.contract.figure import Figure
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics
from crossgrad_core.system.files import disk_errors, write_atomically
from crossgrad_core.system.text_files import as_cell, csv_bytes, parse_number, read_rows


@dataclass(frozen=True)
class Totals:
    """The cost of a run up to an evaluation.

    Attributes:
        step: Number of optimizer steps.
        views: Number of rendered training views.
        backward_passes: Number of backward passes.
        train_seconds: Training seconds without compiling, loading, evaluating and reporting.
        primitives: Number of primitives.
        peak_memory_mib: Peak memory, MiB; None if the system does not report it.
        loss: Mean photometric loss of the last step; None before the first step.
        cpu_seconds: CPU seconds of all threads of the process during training.
        peak_primitives: Largest number of primitives after any step; None if unknown.
    """

    step: int
    views: int
    backward_passes: int
    train_seconds: float
    primitives: int
    peak_memory_mib: float | None
    loss: float | None
    cpu_seconds: float = 0.0
    peak_primitives: int | None = None


FILE = "metrics.csv"
#: Column -> value, or None if the value was not measured.
Row: TypeAlias = dict[str, int | float | None]
_FIRST = ("step", "views", "backward_passes", "train_seconds", "cpu_seconds")
_LAST = ("primitives", "peak_memory_mib", "loss")
_TODO = "restore the file, or repeat the run: crossgrad run --config config.yaml"


def columns_for(regimes: Sequence[str], figures: Sequence[Figure]) -> tuple[str, ...]:
    """Return the columns of metrics.csv for these regimes of held-out views and these metrics."""
    split = [figure for figure in figures if figure.per_regime]
    of_regimes = [figure.column(regime) for regime in sorted(regimes) for figure in split]
    return (*_FIRST, *(figure.name for figure in figures), *of_regimes, *_LAST)


def metrics_row(totals: Totals, result: EvaluationResult) -> Row:
    """Return the row of one evaluation."""
    row: Row = dict(asdict(totals))
    for name, digits in (("train_seconds", 3), ("cpu_seconds", 3), ("peak_memory_mib", 1)):
        if (value := row[name]) is not None:
            row[name] = round(value, digits)
    row |= result.overall.values
    for regime, means in result.regimes.items():
        row |= {figure.column(regime): means[figure.name] for figure in result.figures}
    return {name: row[name] for name in columns_for(list(result.regimes), result.figures)}


@dataclass(frozen=True)
class MetricsCsv:
    """The table of one run.

    Attributes:
        path: The file.
        columns: The columns of the table.
    """

    path: Path
    columns: tuple[str, ...]

    @classmethod
    def create(cls, folder: Path, columns: tuple[str, ...]) -> "MetricsCsv":
        """Create a table with its header and no row."""
        table = cls(folder / FILE, columns)
        table.rewrite(())
        return table

    @classmethod
    def resume(cls, folder: Path, columns: tuple[str, ...], step: int) -> "MetricsCsv":
        """Open the table of a run that continues after `step`; rows of later steps are dropped.

        Raises:
            UserError: The table cannot be read, or its columns belong to another run.
        """
        path = folder / FILE
        if not path.is_file():
            return cls.create(folder, columns)
        table = cls(path, columns)
        lines = _lines(path)
        if not lines or tuple(lines[0]) != table.columns:
            raise UserError(
                "metrics.csv cannot be continued: its columns belong to another run",
                where=path,
                expected=",".join(table.columns),
                found=",".join(lines[0]) if lines else "an empty file",
                todo="resume with the scene and the split that the run was started with",
            )
        # Drop a row with missing cells, which a crash left. The resumed run writes this row again.
        whole = [line for line in lines[1:] if len(line) == len(table.columns)]
        steps = [row["step"] for row in _rows(path, lines[0], whole)]
        lines_and_steps = zip(whole, steps, strict=True)
        table.rewrite([line for line, at in lines_and_steps if at is not None and at <= step])
        return table

    def append(self, row: Mapping[str, int | float | str | None]) -> None:
        """Write a row and wait until it is on the disk; a failed write leaves no partial row.

        Raises:
            ValueError: The row contains a column that is not in the table.
            UserError: The disk is full.
        """
        unknown = set(row) - set(self.columns)
        if unknown:
            message = f"{FILE} does not contain the columns {sorted(unknown)}"
            raise ValueError(message)
        line = csv_bytes([[as_cell(row.get(name)) for name in self.columns]])
        with disk_errors(self.path, len(line)):
            _append(self.path, line)

    def rewrite(self, lines: Sequence[Sequence[str]]) -> None:
        """Replace the whole table by the header and these rows."""
        write_atomically(self.path, csv_bytes([self.columns, *lines]))


def read_metrics(folder: Path) -> tuple[Row, ...]:
    """Return the rows of a run's metrics.csv in order.

    Raises:
        UserError: The file does not exist, or it does not contain numbers.
    """
    path = folder / FILE
    if not path.is_file():
        raise UserError(
            f"the folder does not contain {FILE}",
            where=folder,
            expected="the folder of a crossgrad run",
            todo="name the folder that `crossgrad run` printed",
        )
    header, *lines = _lines(path) or [[]]
    if len(set(header)) < len(header):
        raise _unreadable(path, "a column that occurs twice")
    return _rows(path, header, lines)


def _rows(path: Path, header: Sequence[str], lines: Sequence[Sequence[str]]) -> tuple[Row, ...]:
    try:
        rows = tuple(
            {name: _number(text) for name, text in zip(header, line, strict=True)} for line in lines
        )
    except ValueError as error:
        raise _unreadable(path, str(error)) from error
    wrong = [row["step"] for row in rows if not _is_step(row.get("step"))]
    if wrong:
        raise _unreadable(path, f"the step {wrong[0]}")
    return rows


def _is_step(number: float | None) -> bool:
    """Return True if the value can be a step, or if it is None for an empty cell."""
    return number is None or (isinstance(number, int) and number >= 0)


def _unreadable(path: Path, found: str) -> UserError:
    return UserError(f"{FILE} cannot be read", where=path, found=found, todo=_TODO)


def _append(path: Path, content: bytes) -> None:
    with path.open("ab", buffering=0) as file:
        size = file.tell()
        try:
            left = memoryview(content)
            while left:  # One call may write only a part of the data.
                left = left[file.write(left) :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise


def _lines(path: Path) -> list[list[str]]:
    """Return all complete lines; a last line without a line end is incomplete and left out."""
    return read_rows(path, FILE, _TODO, whole=True)


def _number(text: str) -> int | float | None:
    return None if text == "" else parse_number(text)


PER_VIEW = "per_view.csv"
_NAMES = ("name", "regime")
_RESTORE_VIEWS = "restore the file, or write it again: crossgrad eval RUN"


def write_per_view(folder: Path, result: EvaluationResult, name: str = PER_VIEW) -> None:
    """Write one line per view with name, regime and metrics; an unknown metric gives an empty cell.

    Raises:
        UserError: The disk is full.
    """
    figures = [figure.name for figure in result.figures]
    lines = (
        [view.name, view.regime, *(as_cell(view.values[figure_name]) for figure_name in figures)]
        for view in result.views
    )
    write_atomically(folder / name, csv_bytes([[*_NAMES, *figures], *lines]))


def read_per_view(folder: Path) -> tuple[ViewMetrics, ...]:
    """Return the metrics of every held-out view of a run, in the order of the scene.

    Returns: The metrics of each view; empty if the file does not exist yet.

    Raises:
        UserError: The file is damaged.
    """
    path = folder / PER_VIEW
    if not path.is_file():
        return ()
    header, *lines = read_rows(path, PER_VIEW, _RESTORE_VIEWS) or [[]]
    if tuple(header[:2]) != _NAMES or len(set(header)) < len(header):
        expected = f"a first line that begins with {','.join(_NAMES)}"
        raise _unreadable_view(path, ",".join(header) or "an empty file", expected)
    return tuple(_view(path, header, line) for line in lines)


def _view(path: Path, header: list[str], line: list[str]) -> ViewMetrics:
    if len(line) != len(header):
        expected = f"{len(header)} cells in each line"
        raise _unreadable_view(path, f"{len(line)}: {','.join(line)}", expected)
    try:
        cells = dict(zip(header[2:], line[2:], strict=True))
        values = {name: float(parse_number(cell)) if cell else None for name, cell in cells.items()}
        name, regime = line[:2]
    except (ValueError, OverflowError) as error:
        raise _unreadable_view(path, str(error)) from error
    return ViewMetrics(name, regime, values)


def _unreadable_view(path: Path, found: str, expected: str = "") -> UserError:
    return UserError(
        f"{PER_VIEW} cannot be read",
        where=path,
        expected=expected,
        found=found,
        todo=_RESTORE_VIEWS,
    )
