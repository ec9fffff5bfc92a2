"""The command `crossgrad compare`."""

import os.path
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Final

from crossgrad_core.commands import (
    Progress,
    UserError,
    count,
    one_line,
    showable,
    table_bytes,
    text_bytes,
)
from crossgrad_plugins.compare import narrative, tables
from crossgrad_plugins.compare.comparison import Comparison, compared
from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.figures.curves import (
    draw_curves,
    draw_frontier,
    draw_primitives,
    draw_profile,
    draw_regimes,
)
from crossgrad_plugins.compare.figures.differences import draw_differences
from crossgrad_plugins.compare.figures.phases import draw_phases
from crossgrad_plugins.compare.figures.style import Drawn, looks, variables
from crossgrad_plugins.compare.load_runs import check_places, read_runs
from crossgrad_plugins.compare.narrative import where_text
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.output import FIGURES, MARK, PAGE, check_free, write_files
from crossgrad_plugins.compare.pictures import WorstView, with_pictures, worst_views
from crossgrad_plugins.compare.quantity import COSTS
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.statistics import BOOTSTRAP_FROM, UNCORRECTED
from crossgrad_plugins.compare.tables import (
    TABLES,
    Table,
    contrast_table,
    cost_table,
    csv_tables,
    standing_table,
)

_MEANING: Final = "their speed may differ, and so may their bits"
_MOST_SHOWN: Final = 3


def differing_code(arms: Mapping[str, Runs]) -> list[str]:
    """Return a note if arms, or the runs of a pair, come from different commits or versions.

    A run without a recorded commit or version is ignored.

    Args:
        arms: Arm -> scene and seed -> the run that represents the scene and seed in this arm.
    """
    used = {arm: _all_code(runs) for arm, runs in arms.items()}
    groups: dict[str, list[str]] = {}
    for arm, code in used.items():
        if code:
            groups.setdefault(code, []).append(arm)
    if len(groups) > 1:
        shown = [f"{_named(group)} ran at {code}" for code, group in groups.items()]
        more = len(shown) - _MOST_SHOWN
        parts = [*shown[:_MOST_SHOWN], *([f"{more} more"] if more > 0 else [])]
        return [f"code differs: {'; '.join(parts)}: {_MEANING}"]
    if pair := next(_unlike_pairs(arms), None):
        texts = [f"{run.name} ran at {code_of(run)}" for run in pair]
        return [f"code differs within pairs: {', '.join(texts)}: {_MEANING}"]
    return []


def code_of(run: Run) -> str:
    """Return the commit of a run, else the version of its package, else an empty text."""
    environment = run.summary.get("environment") or {}
    commit, version = environment.get("commit"), environment.get("crossgrad")
    if commit:
        return f"commit {commit}"
    return f"crossgrad {version}" if version else ""


def _all_code(runs: Runs) -> str:
    return " and ".join(sorted({code for run in runs.values() if (code := code_of(run))}))


def _named(arms: list[str]) -> str:
    more = len(arms) - _MOST_SHOWN
    # Arm names contain commas, so each name is quoted.
    names = ", ".join(f"'{arm}'" for arm in arms[:_MOST_SHOWN])
    return names if more <= 0 else f"{names} and {more} more"


def _unlike_pairs(arms: Mapping[str, Runs]) -> Iterator[tuple[Run, Run]]:
    """Yield two runs on one scene with one seed that come from different versions of the code."""
    first_runs: dict[tuple[str, int], Run] = {}
    for runs in arms.values():
        for problem, run in runs.items():
            if code := code_of(run):
                first = first_runs.setdefault(problem, run)
                if code_of(first) != code:
                    yield first, run


_TEMPLATE: Final = Path(__file__).with_name("page.html")
#: Number of table rows that are visible when the page opens. A click shows the other rows.
_OPEN_ROWS: Final = 12
#: Colours of the arms on a dark page: equal hues, but lighter.
_DARK: Final = ("#4fa8e0", "#f08a3c", "#2fc79b", "#e3a1c5", "#f0b93a", "#86c9f2", "#c2a04a")
_WORST_NAMED: Final = 8
#: Field of a run's environment (machine, code) -> text before its value on the page.
_MACHINE: Final = {
    "cpu": "",
    "cpu_cores": "cores: ",
    "torch_threads": "threads: ",
    "device": "device: ",
    "gpu": "GPU: ",
    "crossgrad": "crossgrad ",
    "commit": "commit ",
}


def page_of(
    comparison: Comparison,
    figures: Sequence[Drawn],
    pictured: Sequence[WorstView],
    views: Mapping[str, Sequence[WorstView]],
    notes: Sequence[str],
    version: str,
) -> str:
    """Return the HTML page of a comparison.

    Args:
        comparison: The comparison.
        figures: All figures that could be drawn, in order.
        pictured: The held-out views for which the page shows pictures.
        views: Scene -> all held-out views, the worst first.
        notes: Notes on results that are not compared or not shown, with the reasons.
        version: Version of crossgrad.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                              lstrip_blocks=True, finalize=_shown)  # fmt: skip
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    look = looks([arm.name for arm in comparison.arms])
    variable = {color: name for name, color in variables().items()}
    return template.render(
        mark=Markup(MARK),
        version=version,
        c=comparison,
        sentences=narrative.headline(comparison),
        noise=narrative.noise_sentence(comparison),
        summary=(tables.standing_table(comparison), tables.cost_table(comparison)),
        figures=[(figure, Markup(figure.svg)) for figure in figures],
        contrasts=tables.contrast_tables(comparison),
        others=(tables.reached_table(comparison), tables.settings_table(comparison)),
        runs=tables.runs_table(comparison),
        pictured=pictured,
        worst=[
            tables.views_table(comparison, scene, scene_views[:_WORST_NAMED])
            for scene, scene_views in views.items()
            if scene_views
        ],
        notes=notes,
        machines=machines(comparison),
        light=variables(),
        dark={f"series-{number}": color for number, color in enumerate(_DARK)},
        colors={arm: variable[style.color] for arm, style in look.items()},
        limits={"bootstrap": BOOTSTRAP_FROM, "holm": UNCORRECTED, "open": _OPEN_ROWS},
    )


def _shown(value: object) -> object:
    """Escape the control characters of a text; return any other value unchanged."""
    if not isinstance(value, str):
        return value
    return one_line(value) if type(value) is str else type(value)(showable(value))


def machines(comparison: Comparison) -> list[str]:
    """Return each combination of machine and code, with its number of runs."""
    runs = Counter(
        ", ".join(
            f"{before}{run.environment[key]}"
            for key, before in _MACHINE.items()
            if run.environment.get(key) is not None
        )
        for run in comparison.runs
    )
    return [f"{text} ({count(number, 'run')})" for text, number in runs.items()]


_MOST_ROWS = 20


def lines_of(comparison: Comparison, notes: Sequence[str]) -> Iterator[str]:
    """Yield the lines that the command prints."""
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
    """Yield the lines of a table with aligned columns; the first column is left-aligned."""
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


#: Name of the default output folder, next to the runs.
FOLDER: Final = "compare"
#: Names of all plots that a comparison can draw.
DRAWINGS: Final = (
    *(f"curves_{cost.name}" for cost in COSTS),
    *("differences", "frontier", "phases", "primitives", "profile", "regimes"),
)
#: Files that a comparison can write, in addition to its page.
OWNED: Final = (
    *TABLES,
    *(f"{FIGURES}/{name}.{form}" for name in DRAWINGS for form in ("pdf", "png")),
)


def compare(
    places: Sequence[Path], options: Options, out: Path | None, *, skip_broken: bool
) -> None:
    """Compare runs, write the page, figures and tables to a folder, and print the verdicts.

    Args:
        places: Folders of runs, or folders that contain such folders.
        options: Options of the comparison.
        out: Output folder; by default `compare` next to the runs.
        skip_broken: True to leave out runs with damaged files.

    Raises:
        UserError: No run can be compared, the runs are not comparable, or the folder is in use.
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
        print(one_line(line))  # noqa: T201 - print the result of the command
    shown, page = one_line(folder), one_line(folder / PAGE)
    print(f"\npage, figures and tables in {shown}: open {page}")  # noqa: T201


def _check_numbers(options: Options) -> None:
    for name in ("margin", "target"):
        value = getattr(options, name)
        if value is not None and not isfinite(value):
            raise UserError(
                f"the {name} is not a finite number",
                where=f"--{name}",
                expected="a finite number",
                found=str(value),
                todo="give a finite number, or leave the option out",
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
    """Return the default folder: inside a single folder of runs, else next to the given folders."""
    only = places[0]
    if len(places) == 1 and not (only / "config.yaml").is_file():
        return only / FOLDER
    return Path(os.path.commonpath([path.absolute().parent for path in places])) / FOLDER
