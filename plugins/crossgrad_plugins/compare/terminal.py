"""Output of the command on the terminal: the headline, a table of arms, the verdicts."""

from collections.abc import Iterator, Sequence

from crossgrad_plugins.compare import narrative
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.page import arm_rows, contrast_rows, reference

_MOST_ROWS = 20


def lines_of(comparison: Comparison, notes: Sequence[str]) -> Iterator[str]:
    """The lines."""
    for sentence in narrative.headline(comparison):
        yield f"{sentence.claim}" + (f" ({sentence.support})" if sentence.support else "")
    yield ""
    yield from _table(*_arms(comparison))
    contrasts = [*contrast_rows(comparison.ends), *contrast_rows(comparison.equal)]
    if contrasts:
        yield ""
        yield from _table(*_contrasts(contrasts[:_MOST_ROWS]))
        if len(contrasts) > _MOST_ROWS:
            yield f"... and {len(contrasts) - _MOST_ROWS} more in comparisons.csv"
    if noise := narrative.noise_sentence(comparison):
        yield ""
        yield f"noise floor, standard deviation over seeds: {noise}"
    for note in notes:
        yield f"note: {note}"
    for name, why in comparison.left_out.items():
        yield f"left out: {name}: {why}"


def _arms(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    header = ["arm", *comparison.scenes, f"against {reference(comparison)}"]
    header += [cost.title for cost in comparison.costs] + ["primitives"]
    rows = [
        [row.name, *row.standing, row.against, *row.spent, row.primitives]
        for row in arm_rows(comparison)
    ]
    return header, rows


def _contrasts(rows: Sequence[dict[str, str]]) -> tuple[list[str], list[list[str]]]:
    header = ["first - second", "where", "difference", "95 % interval", "verdict", "pairs"]
    return header, [
        [
            f"{row['first']} - {row['second']}",
            str(row["where"]),
            str(row["difference"]),
            str(row["wide"]),
            f"{row['verdict']}{', scenes differ' if row['opposed'] else ''}",
            str(row["pairs"]),
        ]
        for row in rows
    ]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Columns as wide as their widest cell, the first one to the left."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    for row in (header, *rows):
        first = row[0].ljust(widths[0])
        rest = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        yield "  ".join([first, *rest]).rstrip()
