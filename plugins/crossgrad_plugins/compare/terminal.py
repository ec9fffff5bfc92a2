"""Output of the command on the terminal: the headline, a table of arms, the verdicts."""

from collections.abc import Iterator, Sequence

from crossgrad_plugins.compare import narrative
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.narrative import where_text
from crossgrad_plugins.compare.tables import Table, contrast_table, cost_table, standing_table

_MOST_ROWS = 20


def lines_of(comparison: Comparison, notes: Sequence[str]) -> Iterator[str]:
    """Return the lines."""
    for sentence in narrative.headline(comparison):
        yield f"{sentence.claim}" + (f" ({sentence.support})" if sentence.support else "")
    standing, costs = standing_table(comparison), cost_table(comparison)
    rows = [(*one, *other[1:]) for one, other in zip(standing.rows, costs.rows, strict=True)]
    yield from _lines(Table((*standing.columns, *costs.columns[1:]), rows))
    shown = contrast_table(
        (*comparison.ends, *comparison.equal)[:_MOST_ROWS], first={"where": where_text}
    )
    yield from _lines(shown)
    if more := len(comparison.ends) + len(comparison.equal) - len(shown.rows):
        yield f"... and {more} more in comparisons.csv"
    if noise := narrative.noise_sentence(comparison):
        yield ""
        yield f"noise floor, standard deviation over seeds: {noise}"
    for note in notes:
        yield f"note: {note}"
    for name, why in comparison.left_out.items():
        yield f"left out: {name}: {why}"


def _lines(table: Table) -> Iterator[str]:
    """Return columns as wide as their widest cell, the first one to the left."""
    if not table.rows:
        return
    shown = [index for index, column in enumerate(table.columns) if column.in_terminal]
    titles = [column.title for column in table.columns]
    cells = [[row[index] for index in shown] for row in (titles, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    yield ""
    for first, *rest in cells:
        right = [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *right]).rstrip()
