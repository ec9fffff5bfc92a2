"""The page: one HTML file that needs nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, isnan
from pathlib import Path
from typing import Any, Final

import numpy as np

from crossgrad_core.commands import count, one_line, showable
from crossgrad_plugins.compare import narrative
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.contrasts import Contrast
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.figures.differences import where_text
from crossgrad_plugins.compare.figures.phases import phases_of
from crossgrad_plugins.compare.figures.style import Drawn, looks, variables
from crossgrad_plugins.compare.output import MARK
from crossgrad_plugins.compare.pictures import WorstView
from crossgrad_plugins.compare.statistics.estimate import BOOTSTRAP_FROM
from crossgrad_plugins.compare.statistics.verdict import UNCORRECTED
from crossgrad_plugins.compare.targets import Reached

_TEMPLATE: Final = Path(__file__).with_name("page.html")
#: Rows of a table that are open; more of them are behind a click.
OPEN_ROWS: Final = 12
#: Series colours on a dark page: the same hues, lighter.
_DARK: Final = ("#4fa8e0", "#f08a3c", "#2fc79b", "#e3a1c5", "#f0b93a", "#86c9f2", "#c2a04a")
_WORST_NAMED: Final = 8


@dataclass(frozen=True)
class ArmRow:
    """An arm at a glance."""

    name: str
    color: str
    runs: int
    failed: int
    standing: tuple[str, ...]
    against: str
    verdict: str
    spent: tuple[str, ...]
    primitives: str
    peak: str
    memory: str


def page_of(
    comparison: Comparison,
    figures: Sequence[Drawn],
    pictured: Sequence[WorstView],
    views: Mapping[str, Sequence[WorstView]],
    notes: Sequence[str],
    version: str,
) -> str:
    """The page.

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
    return template.render(
        mark=Markup(MARK),
        version=version,
        c=comparison,
        sentences=narrative.headline(comparison),
        reference=reference(comparison),
        noise=narrative.noise_sentence(comparison),
        rows=arm_rows(comparison),
        figures=[(figure, Markup(figure.svg)) for figure in figures],
        ends=contrast_rows(comparison.ends),
        equal=contrast_rows(comparison.equal),
        regimes=contrast_rows(comparison.regimes),
        others=contrast_rows(comparison.others),
        gains=contrast_rows(comparison.gains),
        reached=reached_rows(comparison),
        phases=phases_of(comparison),
        pictured=pictured,
        worst={scene: own[:_WORST_NAMED] for scene, own in views.items()},
        notes=notes,
        differing=list(dict.fromkeys(k for arm in comparison.arms for k in arm.settings)),
        machines=machines(comparison),
        light=variables(),
        dark=dark_variables(),
        colors={arm: _variable(comparison, arm) for arm in comparison.ranking},
        limits={"bootstrap": BOOTSTRAP_FROM, "holm": UNCORRECTED, "open": OPEN_ROWS},
    )


def _shown(value: object) -> object:
    """Return a text with its control characters as escapes, and all else as it is."""
    if not isinstance(value, str):
        return value
    return one_line(value) if type(value) is str else type(value)(showable(value))


def arm_rows(comparison: Comparison) -> list[ArmRow]:
    """The arms from the best to the worst."""
    return [_arm_row(comparison, name) for name in comparison.ranking]


def _arm_row(comparison: Comparison, name: str) -> ArmRow:
    runs = list(comparison.main[name].values())
    problems = [by.keys() for by in comparison.main.values() if by]
    # Scenes that other arms lack would make its costs another thing than theirs.
    shared = set.intersection(*map(set, problems)) if problems else set()
    own = [run for at, run in comparison.main[name].items() if at in shared] or runs
    failed = next(len(arm.failed) for arm in comparison.arms if arm.name == name)
    against, verdict = _against(comparison, name)
    return ArmRow(
        name=name,
        color=_variable(comparison, name),
        runs=len(runs),
        failed=failed,
        standing=tuple(_standing(comparison, name, scene) for scene in comparison.scenes),
        against=against,
        verdict=verdict,
        spent=tuple(_mean([run.spent(cost) for run in own], cost) for cost in comparison.costs),
        primitives=_mean([run.number("primitives") for run in own]),
        peak=_mean([run.peak_primitives for run in own]),
        memory=_mean([run.number("peak_memory_mib") for run in own]),
    )


def reference(comparison: Comparison) -> str:
    """The arm that the table sets the others against."""
    return comparison.baseline or comparison.ranking[0]


def _against(comparison: Comparison, name: str) -> tuple[str, str]:
    """The difference to the reference, from the arm's side, and the verdict."""
    other = reference(comparison)
    for each in comparison.ends:
        if each.estimate is not None and {each.first, each.second} == {name, other}:
            sign = 1.0 if each.first == name else -1.0
            low, high = sorted(sign * limit for limit in each.estimate.wide)
            text = comparison.quantity.difference(sign * each.estimate.center)
            interval = narrative.interval_text(each, (low, high)).removesuffix(each.quantity.unit)
            return f"{text} [{interval.strip()}]", str(each.verdict)
    return ("reference" if name == other else "no pair"), ""


def _standing(comparison: Comparison, name: str, scene: str) -> str:
    found = comparison.standing[name].get(scene)
    if found is None:
        return "\u2013"
    text = comparison.quantity.shown(found.mean)
    spread = f" \u00b1 {found.spread:.{comparison.quantity.decimals}f}"
    return text if isnan(found.spread) else text + spread


def _mean(values: Sequence[float | None], cost: Cost | None = None) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "\u2013"
    mean = float(np.mean(known))
    return f"{mean:,.0f}" if cost is None else cost.shown(mean).removesuffix(f" {cost.unit}")


def contrast_rows(contrasts: Sequence[Contrast]) -> list[dict[str, Any]]:
    """The contrasts as texts."""
    rows = []
    for each in contrasts:
        found = each.estimate
        if found is None:
            continue
        rows.append(
            {
                "figure": each.quantity.label,
                "where": where_text(each),
                "first": each.first,
                "second": each.second,
                "difference": each.quantity.difference(found.center),
                "wide": narrative.interval_text(each, found.wide),
                "narrow": narrative.interval_text(each, found.narrow),
                "verdict": str(each.verdict),
                "small": each.is_small,
                "pairs": found.pairs,
                "ahead": each.ahead,
                "scenes": found.scenes,
                "needed": (
                    narrative.needed_text(each)
                    if each.verdict == "inconclusive"
                    else narrative.opposed_text(each)
                ),
                "opposed": bool(each.opposed),
                "inside": each.inside,
            }
        )
    return rows


def reached_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """How soon a quality is reached: a row for each scene and arm, a cell for each cost."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for each in comparison.reached:
        row = rows.setdefault((each.scene, each.arm), {"scene": each.scene, "arm": each.arm})
        row["target"] = comparison.quantity.shown(each.target)
        row["reached"] = f"{each.reached} of {len(each.amounts)}"
        row.setdefault("amounts", []).append(_amount(each))
    return list(rows.values())


def _amount(row: Reached) -> str:
    return row.cost.shown(row.median) if isfinite(row.median) else "never (\u221e)"


def machines(comparison: Comparison) -> list[str]:
    """What the runs were run on and with."""
    found: dict[str, int] = {}
    for run in comparison.runs:
        of = run.summary.get("environment") or {}
        text = ", ".join(
            f"{before}{of[key]}"
            for key, before in (
                ("cpu", ""),
                ("cpu_cores", "cores: "),
                ("torch_threads", "threads: "),
                ("device", "device: "),
                ("gpu", "GPU: "),
                ("crossgrad", "crossgrad "),
                ("commit", "commit "),
            )
            if of.get(key) is not None
        )
        found[text] = found.get(text, 0) + 1
    return [f"{text} ({count(runs, 'run')})" for text, runs in found.items()]


def dark_variables() -> dict[str, str]:
    """Series colours of the dark page."""
    return {f"series-{number}": color for number, color in enumerate(_DARK)}


def _variable(comparison: Comparison, name: str) -> str:
    """The variable of the style sheet that has the colour of an arm."""
    color = looks([arm.name for arm in comparison.arms])[name].color
    return next(variable for variable, value in variables().items() if value == color)
