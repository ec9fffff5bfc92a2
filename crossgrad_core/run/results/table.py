"""The final table that a run shows in the terminal."""

from collections.abc import Sequence

from crossgrad_core.contract.figure import Figure
from crossgrad_core.evaluation.result import EvaluationResult, Means
from crossgrad_core.run.results.cost_totals import Totals

_NULL = "-"


def final_table(result: EvaluationResult | None, totals: Totals) -> str:
    """Metrics overall and per regime, and what they cost, as plain text without a final newline."""
    lines = () if result is None else metric_lines(result)
    return "\n".join([*lines, cost_line(totals)])


def metric_lines(result: EvaluationResult) -> list[str]:
    """Metrics overall and per regime, and why one is missing."""
    reasons = (f"no {metric}: {reason}" for metric, reason in _shown(result))
    return [*_aligned(_rows(result)), *reasons]


def cost_line(totals: Totals) -> str:
    """Training seconds, steps, rendered views, primitives and memory in one line."""
    peak = totals.peak_memory_mib
    memory = "" if peak is None else f", peak memory {peak:,.0f} MiB"
    return (
        f"{totals.train_seconds:,.1f} s training, {totals.step:,} steps, "
        f"{totals.views:,} views rendered, {totals.backward_passes:,} backward passes, "
        f"{totals.primitives:,} primitives{memory}"
    )


def _rows(result: EvaluationResult) -> list[tuple[str, ...]]:
    # What is not defined for these views has no column.
    shown = [each for each in result.figures if result.reasons.get(each.name) != each.undefined]
    header = ("", "views", *(figure.label for figure in shown))
    rows = [header, _row("overall", result.overall, shown)]
    # A single regime would only repeat the first row.
    if len(result.regimes) > 1:
        rows += [_row(name, means, shown) for name, means in result.regimes.items()]
    return rows


def _row(name: str, means: Means, figures: Sequence[Figure]) -> tuple[str, ...]:
    cells = (_number(means[figure.name], figure.form) for figure in figures)
    return (name, str(means.views), *cells)


def _number(value: float | None, form: str) -> str:
    return _NULL if value is None else format(value, form)


def _shown(result: EvaluationResult) -> list[tuple[str, str]]:
    """Why the figures that are told by regime are missing; of others that is no news."""
    told = [figure.name for figure in result.figures if figure.per_regime]
    return [(name, why) for name, why in result.reasons.items() if name in told]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines
