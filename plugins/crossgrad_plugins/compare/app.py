"""The command `crossgrad compare`."""

import os.path
from collections.abc import Sequence
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Final

from crossgrad_core.commands import Progress, UserError, count, one_line, table_bytes, text_bytes
from crossgrad_plugins.compare.checks.code import differing_code
from crossgrad_plugins.compare.comparison import Comparison, compared
from crossgrad_plugins.compare.cost import COSTS
from crossgrad_plugins.compare.figures.curves import (
    draw_curves,
    draw_frontier,
    draw_primitives,
    draw_regimes,
)
from crossgrad_plugins.compare.figures.differences import draw_differences
from crossgrad_plugins.compare.figures.phases import draw_phases
from crossgrad_plugins.compare.figures.profile import draw_profile
from crossgrad_plugins.compare.figures.style import Drawn
from crossgrad_plugins.compare.load_runs import check_places, read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.output import FIGURES, PAGE, check_free, write_files
from crossgrad_plugins.compare.page import page_of
from crossgrad_plugins.compare.pictures import with_pictures, worst_views
from crossgrad_plugins.compare.tables import TABLES, csv_tables
from crossgrad_plugins.compare.terminal import lines_of

#: Where a comparison goes by default, beside the runs.
FOLDER: Final = "compare"
#: All figures that there can be.
DRAWINGS: Final = (
    *(f"curves_{cost.name}" for cost in COSTS),
    *("differences", "frontier", "phases", "primitives", "profile", "regimes"),
)
#: What a comparison writes, besides its page.
OWNED: Final = (
    *TABLES,
    *(f"{FIGURES}/{name}.{form}" for name in DRAWINGS for form in ("pdf", "png")),
)


def compare(
    places: Sequence[Path], options: Options, out: Path | None, *, skip_broken: bool
) -> None:
    """Compares runs; writes page, figures and tables to a folder, and prints the verdicts.

    Args:
        places: Folders of runs, or folders with runs below.
        options: How to compare.
        out: Where the results go; by default `compare` beside the runs.
        skip_broken: Leave out runs with damaged files.

    Raises:
        UserError: There is nothing to compare, it does not compare, or the folder is in use.
    """
    progress = Progress()
    _check_numbers(options)
    check_places(places)
    folder = _default_folder(places) if out is None else out
    check_free(folder, OWNED)
    progress.tell("reading runs")
    comparison = compared(read_runs(places, skip_broken=skip_broken), options)
    runs, arms = count(len(comparison.runs), "run"), count(len(comparison.arms), "arm")
    progress.tell(f"drawing {runs} of {arms}")
    views = worst_views(comparison)
    pictured, unreadable = with_pictures(comparison, views)
    figures = drawn_figures(comparison)
    notes = (*comparison.notes, *differing_code(comparison.main), *unreadable)
    page = page_of(comparison, figures, pictured, views, notes, version("crossgrad"))
    files = {PAGE: text_bytes(page)}
    files |= {f"{FIGURES}/{figure.name}.pdf": figure.pdf for figure in figures}
    files |= {f"{FIGURES}/{figure.name}.png": figure.png for figure in figures}
    files |= {
        name: table_bytes(rows) for name, rows in csv_tables(comparison, views).items() if rows
    }
    write_files(folder, files, OWNED)
    for line in lines_of(comparison, notes):
        print(one_line(line))  # noqa: T201 - the result of the command
    shown, page = one_line(folder), one_line(folder / PAGE)
    print(f"\npage, figures and tables in {shown}: open {page}")  # noqa: T201


def _check_numbers(options: Options) -> None:
    for name in ("margin", "target"):
        value = getattr(options, name)
        if value is not None and not isfinite(value):
            raise UserError(
                f"the {name} is no number that a figure can have",
                where=f"--{name}",
                expected="a finite number",
                found=str(value),
                todo="give one, or leave it out",
            )


def drawn_figures(comparison: Comparison) -> list[Drawn]:
    """Draw all figures that can be drawn, in the order of the page."""
    first, *rest = comparison.costs
    figures = (
        draw_curves(comparison, first),
        draw_differences(comparison),
        draw_frontier(comparison, first),
        draw_regimes(comparison),
        *(draw_curves(comparison, cost) for cost in rest),
        draw_profile(comparison),
        draw_primitives(comparison, first),
        draw_phases(comparison),
    )
    return [figure for figure in figures if figure is not None]


def _default_folder(places: Sequence[Path]) -> Path:
    """In the only place, where that is no run itself; else beside what was named."""
    only = places[0]
    if len(places) == 1 and not (only / "config.yaml").is_file():
        return only / FOLDER
    return Path(os.path.commonpath([place.absolute().parent for place in places])) / FOLDER
