"""The table of decided settings as text: a few lines for the terminal, or all of them."""

from collections.abc import Iterable, Sequence
from typing import Final

from crossgrad_core.contract.decision import Decision

#: Lines of decisions that the terminal shows.
LINES: Final = 12


def short_lines(rows: Iterable[Decision]) -> tuple[str, ...]:
    """Return one line for each decision that differs from the published value, `LINES` at most."""
    shown = [f"{_value(row)}: {row.because} ({row.override})" for row in rows if row.override]
    left = len(shown) - LINES
    if left > 0:
        shown = [*shown[: LINES - 1], f"{left + 1} more decisions (-v shows all)"]
    return tuple(shown)


def full_lines(rows: Iterable[Decision]) -> tuple[str, ...]:
    """Return one line for each decision, with its evidence."""
    told = ((row, "; ".join(filter(None, (row.because, row.evidence)))) for row in rows)
    return tuple(
        f"{_value(row)}: {text}" + (f" ({row.override})" if row.override else "")
        for row, text in told
    )


def table_lines(rows: Sequence[Decision]) -> tuple[str, ...]:
    """Return the table in columns: setting, value, reason."""
    names = max((len(row.setting) for row in rows), default=0)
    values = max((len(shown(row.value)) for row in rows), default=0)
    return tuple(
        f"{row.setting:<{names}}  {shown(row.value):<{values}}  {row.because}" for row in rows
    )


def _value(row: Decision) -> str:
    return f"{row.setting} {shown(row.value)}"


def shown(value: object) -> str:
    """Return a value as a table shows it."""
    match value:
        case dict():
            return ", ".join(f"{name} {shown(each)}" for name, each in value.items()) or "on"
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.3g}"
        case int():
            return f"{value:,}"
    return str(value)
