"""Report the results of a search as text."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from crossgrad_core.commands import write_table
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.search.worst_cases import WorstCases

#: Largest allowed share of ordinary gradients outside the set, and smallest number of gradients for
#: this check.
SHARE, ENOUGH = 0.01, 2000

#: Counts that are columns of the CSV file.
COUNTS = (
    "matrices",
    "outside",
    "usual",
    "ordinary_outside",
    "unproven",
    "not_finite",
    "broken",
)

_HEAD = (
    f"{'operator':<16}{'type':<9}{'matrices':>9}{'outside':>9}{'usual':>8}{'error':>10}"
    f"{'|u|':>10}{'jump':>10}{'infinite':>9}{'unproven':>9}{'broken':>8}"
)
LEGEND = (
    "outside: share of the matrices that are outside the operator's set (docs/operators.md).\n"
    "usual: share of the ordinary matrices that are outside the set. At most 1 % is allowed.\n"
    "  Ordinary matrices have K = 2 to 20, P = 1 to 50, and norms over seven decades.\n"
    "error: largest error inside the set, in units of u kappa.\n"
    "|u|: longest result outside the set, divided by the longest gradient.\n"
    "jump: largest change of a result, divided by the length of the longest gradient, after all\n"
    "  gradient elements change by a factor near 1 + 1e-12, where the method is continuous.\n"
    "infinite: results that are not finite.\n"
    "unproven: matrices for which no 50-digit reference was proven."
)


def as_text(tallies: Sequence[WorstCases]) -> str:
    """Return the table, the worst cases of each operator, and the broken guarantees."""
    used = [tally for tally in tallies if tally.matrices]
    worst = [line for tally in used for line in _worst(tally)]
    parts = ["\n".join([_HEAD, *map(_line, used)]), LEGEND, "\n".join(["worst cases:", *worst])]
    return "\n\n".join([*parts, _failures(used)])


def write_csv(tallies: Sequence[WorstCases], path: Path) -> None:
    """Write one row for each operator and type."""
    write_table(path, [_row(tally) for tally in tallies])


def _row(tally: WorstCases) -> dict[str, str | int | float]:
    worst = [pool[0] if pool else None for pool in (tally.inside_pool, tally.outside_pool)]
    figures = zip(("error_u_kappa", "u_longest", "jump"), (*worst, tally.jump), strict=True)
    return {
        "operator": tally.operator,
        "type": tally.precision,
        **{name: getattr(tally, name) for name in COUNTS},
        **{name: sample.value if sample else "" for name, sample in figures},
    }


def failed(tally: WorstCases) -> bool:
    """Return True if a guarantee was broken."""
    return tally.broken > 0 or _too_often_outside(tally)


def _too_often_outside(tally: WorstCases) -> bool:
    return tally.usual >= ENOUGH and tally.ordinary_share > SHARE


def _line(tally: WorstCases) -> str:
    error = f"{tally.inside_pool[0].value:.3g}" if tally.inside_pool else "-"
    ratio = f"{tally.outside_pool[0].value:.3g}" if tally.outside_pool else "-"
    jump = f"{tally.jump.value:.1e}" if tally.jump is not None else "-"
    outside = tally.outside / tally.matrices
    return (
        f"{tally.operator:<16}{tally.precision:<9}{tally.matrices:>9}{outside:>9.2%}"
        f"{tally.ordinary_share:>8.2%}{error:>10}{ratio:>10}{jump:>10}{tally.not_finite:>9}"
        f"{tally.unproven:>9}{tally.broken:>8}"
    )


def _worst(tally: WorstCases) -> Iterator[str]:
    if tally.inside_pool:
        yield _described(tally, tally.inside_pool[0], f"error {tally.inside_pool[0].value:.3g}")
    if tally.outside_pool:
        yield _described(tally, tally.outside_pool[0], f"|u| {tally.outside_pool[0].value:.3g}")


def _described(tally: WorstCases, specimen: Sample, what: str) -> str:
    views, elements = specimen.rows.shape
    return (
        f"{tally.operator}, {tally.precision}: {what} (K = {views}, P = {elements}, "
        f"{specimen.family}, round {specimen.turn})\n  --rows '{specimen.text()}'"
    )


def _failures(tallies: Sequence[WorstCases]) -> str:
    lines = [
        _described(tally, specimen, reason)
        for tally in tallies
        for specimen, reason in tally.failures
    ]
    lines += [
        f"{tally.operator}, {tally.precision}: {tally.ordinary_share:.2%} of ordinary gradients "
        "outside"
        for tally in tallies
        if _too_often_outside(tally)
    ]
    if not lines:
        return "no broken guarantee"
    return "\n".join(["broken guarantees:", *lines])
