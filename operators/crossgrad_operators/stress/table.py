"""The suite's results as text: operator x case, error and time side by side."""

from collections.abc import Sequence
from math import isfinite, isnan
from pathlib import Path

from crossgrad_core.commands import write_table
from crossgrad_operators.stress.promises import PROMISED
from crossgrad_operators.stress.runner import Cell

#: Operators side by side in one part of the table.
COLUMNS = 5
_NAME, _CELL = 24, 16

LEGEND = (
    "Each cell: relative error in units of u kappa (8 is promised) and microseconds.\n"
    "u: unit roundoff of the gradients' type; kappa = max |w_k| |g_k| / |u|, at least 1.\n"
    "~ kappa u > 0.1, finite is all that is promised; * outside the operator's set\n"
    "(docs/operators.md): finite and not too long; - K is refused; FAIL see below.\n"
    "Without an error: no reference; finite, and the laws at the end hold."
)


def as_text(cells: Sequence[Cell]) -> str:
    """The whole table, a line per operator, and what failed."""
    names = list(dict.fromkeys(cell.operator for cell in cells))
    parts = [
        _part(cells, names[start : start + COLUMNS]) for start in range(0, len(names), COLUMNS)
    ]
    return "\n\n".join([*parts, LEGEND, _summary(cells, names), *_failures(cells)])


def failed(cells: Sequence[Cell]) -> list[Cell]:
    """The cells that break a promise."""
    return [cell for cell in cells if cell.finding.verdict == "failed"]


def write_csv(cells: Sequence[Cell], path: Path) -> None:
    """One row per cell."""
    rows: list[dict[str, str | int | float]] = [
        {
            "operator": cell.operator,
            "case": cell.case,
            "verdict": cell.finding.verdict,
            "error_u_kappa": cell.finding.error,
            "microseconds": cell.microseconds,
            "reason": cell.finding.reason,
        }
        for cell in cells
    ]
    write_table(path, rows)


def _part(cells: Sequence[Cell], names: Sequence[str]) -> str:
    by_place = {(cell.case, cell.operator): cell for cell in cells}
    lines = [" " * _NAME + "".join(f"{name:>{_CELL}}" for name in names)]
    for case in dict.fromkeys(cell.case for cell in cells):
        row = "".join(f"{_shown(by_place[case, name]):>{_CELL}}" for name in names)
        lines.append(f"{case:<{_NAME}}{row}")
    return "\n".join(lines)


def _shown(cell: Cell) -> str:
    time = "" if isnan(cell.microseconds) else f"{cell.microseconds:8.0f}"
    if cell.finding.verdict == "refused":
        return "-" + " " * 8
    if cell.finding.verdict == "failed":
        return "FAIL" + (time or " " * 8)
    mark = {"undetermined": "~", "outside": "*"}.get(cell.finding.verdict, "")
    error = f"{cell.finding.error:.2f}" if isfinite(cell.finding.error) else ""
    return f"{mark}{error}{time or ' ' * 8}"


def _summary(cells: Sequence[Cell], names: Sequence[str]) -> str:
    lines = [f"{'operator':<{_NAME}}{'worst error':>12}  of {PROMISED:g}   in case"]
    for name in names:
        judged = [c for c in cells if c.operator == name and c.finding.verdict == "ok"]
        worst = max(
            (c for c in judged if isfinite(c.finding.error)),
            key=lambda c: c.finding.error,
            default=None,
        )
        if worst is not None:
            lines.append(f"{name:<{_NAME}}{worst.finding.error:>12.3f}         {worst.case}")
    return "\n".join(lines)


def _failures(cells: Sequence[Cell]) -> list[str]:
    wrong = failed(cells)
    total = sum(cell.finding.verdict != "refused" for cell in cells)
    if not wrong:
        return [f"all {total} checks hold"]
    lines = [f"{cell.operator}, {cell.case}: {cell.finding.reason}" for cell in wrong]
    return ["\n".join([f"{len(wrong)} of {total} checks fail:", *lines])]
