"""`crossgrad stress`: compare operators with exact arithmetic on extreme gradients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import typer

from crossgrad_core.commands import (
    Progress,
    UserError,
    announce,
    argument,
    check_file,
    check_new,
    command_of,
    option,
)

if TYPE_CHECKING:
    import torch

    from crossgrad_operators.stress.runner import Cell
    from crossgrad_operators.stress.search.worst_cases import WorstCases

#: Default number of elements of the largest gradients.
LARGE = 10_000_000
#: Option -> kinds of tests that use this option. An empty kind of test means the fixed test cases.
_USED: Final[Mapping[str, tuple[str, ...]]] = {
    "--case": ("",),
    "--elements": ("",),
    "--type": ("--search", "--matrices", "--rows"),
    "--seed": ("--search", "--matrices"),
}
#: Seconds between two progress messages of a search.
PAUSE = 10.0


#: Types of gradients, as torch dtypes.
Types: TypeAlias = "tuple[torch.dtype, ...]"


class Precision(StrEnum):
    """Types of the gradients in a search."""

    FLOAT32 = "float32"
    FLOAT64 = "float64"
    BOTH = "both"

    @property
    def dtypes(self) -> Types:
        """The selected types as torch dtypes."""
        import torch

        both = {"float32": torch.float32, "float64": torch.float64}
        return tuple(both.values()) if self == Precision.BOTH else (both[self.value],)


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of the command."""

    operators: list[str] | None = argument(
        "OPERATOR...", "Names of operators. Default: all installed.", default=None
    )
    case: str | None = option(None, "Run only cases whose name contains this text.", "TEXT")
    elements: int | None = option(
        None, f"Number of elements of the largest gradients. Default: {LARGE:,}.", "N", min=1000
    )
    csv: Path | None = option(None, "Also write the table to this CSV file.", "FILE")
    search: float | None = option(
        None,
        "Instead of the fixed cases: search at random for the worst gradients, for this time.",
        "SECONDS",
    )
    matrices: int | None = option(
        None,
        "Instead of the fixed cases: check whether results are finite for N short random matrices.",
        "N",
        min=1,
    )
    rows: str | None = option(
        None,
        "Instead of the fixed cases: run this case, one row per view, as a search prints it.",
        "[[...],...]",
    )
    precision: Precision | None = option(
        None,
        "Type of gradients for --search, --matrices and --rows. Default: both.",
        flag="--type",
    )
    seed: int | None = option(None, "Seed of --search and --matrices. Default: 0.", "N", min=0)


@command_of(Options)
def stress(given: Options) -> None:
    """Test the accuracy of operators on extreme gradients.

    Results are compared with 50-digit arithmetic. The exit status is 1 if an operator is less
    accurate than docs/operators.md guarantees.
    """
    announce()
    _refuse_idle(given)
    from crossgrad_operators.stress.suite import installed

    csv, seed = given.csv, given.seed or 0
    if csv is not None:
        check_file(csv)
        check_new(csv)
    names = given.operators or installed()
    dtypes = (given.precision or Precision.BOTH).dtypes
    if given.search is not None:
        right = _search(names, dtypes, (seed, given.search), csv)
    elif given.matrices is not None:
        right = _matrices(names, dtypes, (seed, given.matrices), csv)
    elif given.rows is not None:
        right = _rows(names, dtypes, given.rows, csv)
    else:
        right = _cases(names, given.case, given.elements or LARGE, csv)
    if not right:
        raise typer.Exit(1)


def _refuse_idle(given: Options) -> None:
    """Raise an error for options that have no effect in the selected kind of test."""
    modes = {"--search": given.search, "--matrices": given.matrices, "--rows": given.rows}
    others = {
        "--case": given.case,
        "--elements": given.elements,
        "--type": given.precision,
        "--seed": given.seed,
    }
    chosen = [name for name, value in modes.items() if value is not None]
    if len(chosen) > 1:
        raise UserError(
            f"{' and '.join(chosen)} cannot be combined",
            todo="use only one of them; each option starts a different kind of run",
        )
    mode = chosen[0] if chosen else ""
    idle = [name for name, value in others.items() if value is not None and mode not in _USED[name]]
    if idle:
        raise UserError(
            f"{' and '.join(idle)} has no effect with {mode or 'the fixed cases'}",
            todo="leave it out",
        )


def _cases(names: Sequence[str], case: str | None, elements: int, csv: Path | None) -> bool:
    from crossgrad_operators.stress.cases import cases
    from crossgrad_operators.stress.suite import run_suite

    chosen = [choice for choice in cases(large=elements) if (case or "") in choice.name]
    if not chosen:
        raise UserError(
            "no case name contains this text",
            where=f"--case {case}",
            expected=f"a part of {', '.join(choice.name for choice in cases(large=elements))}",
            todo="leave --case out to run all cases",
        )
    return _table(list(run_suite(names, chosen, progress=Progress().tell)), csv)


def _rows(names: Sequence[str], dtypes: Types, rows: str, csv: Path | None) -> bool:
    from crossgrad_operators.stress.search.repeat import read_rows, run_rows
    from crossgrad_operators.stress.suite import subject_of

    chosen = [read_rows(rows, dtype) for dtype in dtypes]
    subjects = [subject_of(name) for name in names]
    return _table([cell for case in chosen for cell in run_rows(subjects, case)], csv)


def _table(cells: "list[Cell]", csv: Path | None) -> bool:
    from crossgrad_operators.stress.suite import as_text, failed, write_csv

    typer.echo(as_text(cells))
    if csv is not None:
        write_csv(cells, csv)
    return not failed(cells)


def _search(
    names: Sequence[str], dtypes: Types, extent: tuple[int, float], csv: Path | None
) -> bool:
    from crossgrad_operators.stress.search.loop import Extent, search
    from crossgrad_operators.stress.search.report import as_text, failed, write_csv
    from crossgrad_operators.stress.suite import subject_of

    seed, seconds = extent
    wanted = Extent(seed=seed, seconds=seconds, dtypes=dtypes)
    tallies = search([subject_of(name) for name in names], wanted, progress=_Clock().tick)
    typer.echo(as_text(tallies))
    if csv is not None:
        write_csv(tallies, csv)
    return not any(map(failed, tallies))


def _matrices(
    names: Sequence[str], dtypes: Types, extent: tuple[int, int], csv: Path | None
) -> bool:
    from crossgrad_operators.stress.search.finite import as_text, run_finite, write_csv
    from crossgrad_operators.stress.suite import subject_of

    seed, matrices = extent
    results, progress = [], Progress()
    for subject in [subject_of(name) for name in names]:
        progress.tell(subject.name)
        results.append(run_finite(subject, matrices, seed, dtypes))
    typer.echo(as_text(results))
    if csv is not None:
        write_csv(results, csv)
    return not any(result.not_finite for result in results)


class _Clock:
    """A printer that shows the progress of a search at regular intervals."""

    def __init__(self) -> None:
        self._progress = Progress(PAUSE)

    def tick(self, turn: int, tallies: "Sequence[WorstCases]") -> None:
        if self._progress.due:
            matrices, broken = (sum(getattr(t, n) for t in tallies) for n in ("matrices", "broken"))
            self._progress.tell(f"round {turn}: {matrices} matrices, {broken} break a guarantee")
