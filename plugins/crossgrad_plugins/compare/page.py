"""The page: one HTML file that needs nothing else."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from crossgrad_core.commands import count, one_line, showable
from crossgrad_plugins.compare import narrative, tables
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.figures.style import Drawn, looks, variables
from crossgrad_plugins.compare.output import MARK
from crossgrad_plugins.compare.pictures import WorstView
from crossgrad_plugins.compare.statistics.estimate import BOOTSTRAP_FROM
from crossgrad_plugins.compare.statistics.verdict import UNCORRECTED

_TEMPLATE: Final = Path(__file__).with_name("page.html")
#: Rows of a table that are open; more of them are behind a click.
_OPEN_ROWS: Final = 12
#: Series colours on a dark page: the same hues, lighter.
_DARK: Final = ("#4fa8e0", "#f08a3c", "#2fc79b", "#e3a1c5", "#f0b93a", "#86c9f2", "#c2a04a")
_WORST_NAMED: Final = 8
#: What a run's environment says about its machine and code -> what is written before it.
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
    """Return the page.

    Args:
        comparison: What was found.
        figures: All figures that could be drawn, in order.
        pictured: The views that are shown.
        views: Scene -> all held-out views, the worst first.
        notes: What is not compared or shown, and why.
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
            tables.views_table(comparison, scene, own[:_WORST_NAMED])
            for scene, own in views.items()
            if own
        ],
        notes=notes,
        machines=machines(comparison),
        light=variables(),
        dark={f"series-{number}": color for number, color in enumerate(_DARK)},
        colors={arm: variable[each.color] for arm, each in look.items()},
        limits={"bootstrap": BOOTSTRAP_FROM, "holm": UNCORRECTED, "open": _OPEN_ROWS},
    )


def _shown(value: object) -> object:
    """Return a text with its control characters as escapes, and all else as it is."""
    if not isinstance(value, str):
        return value
    return one_line(value) if type(value) is str else type(value)(showable(value))


def machines(comparison: Comparison) -> list[str]:
    """Return the machines and code of the runs, with the number of runs of each."""
    runs = Counter(
        ", ".join(
            f"{before}{run.environment[key]}"
            for key, before in _MACHINE.items()
            if run.environment.get(key) is not None
        )
        for run in comparison.runs
    )
    return [f"{text} ({count(number, 'run')})" for text, number in runs.items()]
