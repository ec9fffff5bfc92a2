"""The tables of a comparison: texts for page and terminal, values for CSV files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, isnan, nan
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from crossgrad_core.commands import count
from crossgrad_plugins.compare import narrative
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.contrasts import Contrast
from crossgrad_plugins.compare.figures.panels import band
from crossgrad_plugins.compare.figures.phases import phases_of
from crossgrad_plugins.compare.narrative import interval_text, where_text
from crossgrad_plugins.compare.pictures import WorstView
from crossgrad_plugins.compare.quantity import COSTS, Cost
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.statistics import UNCORRECTED, Estimate, Verdict
from crossgrad_plugins.compare.targets import Reached

Row = dict[str, str | int | float]
#: File names of all tables.
TABLES: Final = (
    *("runs.csv", "arms.csv", "comparisons.csv", "pairs.csv", "time_to_quality.csv"),
    *("curves.csv", "lengths.csv", "noise.csv", "phases.csv", "views.csv"),
)
_NONE: Final = "\u2013"


class Column(NamedTuple):
    """A column of a table of the page and the terminal.

    Attributes:
        title: Heading of the column.
        kind: Format on the page: `number`, `text`, `arm`, `verdict` or `note`.
        in_terminal: True if the terminal shows the column.
    """

    title: str
    kind: str = "number"
    in_terminal: bool = True


@dataclass(frozen=True)
class Table:
    """A table of the page and the terminal.

    Attributes:
        columns: The columns.
        rows: The rows, each with one text per column.
        title: Title of the table.
        caption: Description of the table.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""


_ARM: Final = Column("arm", "arm")


def standing_table(c: Comparison) -> Table:
    """Return the table of arms from best to worst, with metrics and differences."""
    reference = c.baseline or c.ranking[0]
    unit = f", {c.quantity.unit}" if c.quantity.unit else ""
    return Table(
        [
            *(_ARM, *map(Column, c.scenes)),
            *(Column(f"against {reference}"), Column("verdict", "verdict", in_terminal=False)),
        ],
        [
            [arm, *(_standing(c, arm, scene) for scene in c.scenes), *_against(c, arm, reference)]
            for arm in c.ranking
        ],
        caption=f"{c.quantity.label} at the end of the runs, mean ± standard deviation over "
        f"seeds{unit}. Arms are sorted from best to worst. Differences are paired by "
        "scene and seed, with 95 % intervals.",
    )


def _standing(c: Comparison, arm: str, scene: str) -> str:
    standing = c.standing[arm].get(scene)
    if standing is None:
        return _NONE
    spread = f" \u00b1 {standing.spread:.{c.quantity.decimals}f}"
    return c.quantity.shown(standing.mean) + ("" if isnan(standing.spread) else spread)


def _against(c: Comparison, arm: str, reference: str) -> tuple[str, str]:
    """Return the difference of an arm from the reference arm, and the verdict."""
    for contrast in c.ends:
        if contrast.estimate is not None and {contrast.first, contrast.second} == {arm, reference}:
            sign = 1.0 if contrast.first == arm else -1.0
            low, high = sorted(sign * limit for limit in contrast.estimate.wide)
            interval = interval_text(contrast, (low, high)).removesuffix(contrast.quantity.unit)
            text = c.quantity.difference(sign * contrast.estimate.center)
            return f"{text} [{interval.strip()}]", str(contrast.verdict)
    return ("reference" if arm == reference else "no pair"), ""


def cost_table(c: Comparison) -> Table:
    """Return the mean costs of each arm.

    Only scenes and seeds that all arms have are used.
    """
    problems = [by.keys() for by in c.main.values() if by]
    shared = set.intersection(*map(set, problems)) if problems else set()
    rows = []
    for arm in c.ranking:
        runs = [run for problem, run in c.main[arm].items() if problem in shared]
        runs = runs or list(c.main[arm].values())
        failed = next(len(arm_record.failed) for arm_record in c.arms if arm_record.name == arm)
        row = [arm, *(_mean([run.spent(cost) for run in runs], cost) for cost in c.costs)]
        row += [
            _mean([run.number("primitives") for run in runs]),
            _mean([run.number("peak_primitives") for run in runs]),
            _mean([run.number("peak_memory_mib") for run in runs]),
            f"{len(c.main[arm])}" + (f" + {failed} failed" if failed else ""),
        ]
        rows.append(row)
    columns = [_ARM, *(Column(cost.title) for cost in c.costs), Column("Gaussians at the end")]
    columns += [Column(name, in_terminal=False) for name in ("at most", "memory, MiB", "runs")]
    caption = "Mean cost of a run. Seconds are training seconds."
    return Table(columns, rows, caption=caption)


def _mean(values: Sequence[float | None], cost: Cost | None = None) -> str:
    numbers = [value for value in values if value is not None]
    if not numbers:
        return _NONE
    mean = float(np.mean(numbers))
    return f"{mean:,.0f}" if cost is None else cost.shown(mean).removesuffix(f" {cost.unit}")


def contrast_tables(c: Comparison) -> tuple[Table, ...]:
    """Return the tables of contrasts, without empty tables."""
    tables = (
        contrast_table(c.ends, "At the end of the runs", "The primary comparison."),
        contrast_table(
            c.equal,
            "At equal cost",
            "Read at the last evaluation of the run that spent least, by scene; costs "
            "that are equal at the end of all runs have no row. * : these runs were read "
            "before their end, when their schedule was not complete; only runs of that "
            "length show the quality that the arm reaches.",
            {"equal": where_text},
        ),
        contrast_table(
            c.regimes,
            "By regime",
            "At the end of the runs, over all held-out views and over the views of each regime.",
            {"views": where_text},
        ),
        contrast_table(
            c.others,
            "Other figures",
            "At the end of the runs, over all held-out views.",
            {"figure": lambda contrast: contrast.quantity.label},
        ),
        contrast_table(
            c.gains,
            "Gain of longer runs",
            "Within an arm, runs of one length compared with runs of the next shorter "
            "length, paired by scene and seed.",
            {"arm": where_text},
        ),
    )
    return tuple(table for table in tables if table.rows)


def contrast_table(
    contrasts: Sequence[Contrast],
    title: str = "",
    caption: str = "",
    first: Mapping[str, Callable[[Contrast], str]] = MappingProxyType({}),
) -> Table:
    """Return a table with one contrast per row.

    Args:
        contrasts: The contrasts.
        title: Title of the table.
        caption: Description of the table.
        first: Heading -> function that returns the text, for columns before all other columns.
    """
    if len(contrasts) > UNCORRECTED:
        caption += (
            f" Verdicts are corrected with Holm's method over the {len(contrasts)} "
            "comparisons of this table; intervals are not corrected."
        )
    columns = [
        *(Column(name, "text") for name in (*first, "first", "second")),
        *(Column("first \u2212 second"), Column("95 % interval")),
        *(Column("90 % interval", in_terminal=False), Column("verdict", "verdict")),
        *(Column("pairs"), Column("first better"), Column("", "note", in_terminal=False)),
    ]
    rows = [
        [
            *(text(contrast) for text in first.values()),
            *_contrast_texts(contrast, contrast.estimate),
        ]
        for contrast in contrasts
        if contrast.estimate is not None
    ]
    return Table(columns, rows, title, caption)


def _contrast_texts(contrast: Contrast, estimate: Estimate) -> list[str]:
    inconclusive = contrast.verdict is Verdict.INCONCLUSIVE
    small = contrast.verdict is Verdict.DIFFERENT and contrast.is_small
    qualified = " (below the margin)" * small + ", with different signs on different scenes" * bool(
        contrast.opposed
    )
    note = narrative.needed_text if inconclusive else narrative.opposed_text
    return [
        contrast.first,
        contrast.second,
        contrast.quantity.difference(estimate.center),
        interval_text(contrast, estimate.wide),
        interval_text(contrast, estimate.narrow),
        f"{contrast.verdict}{qualified}",
        str(estimate.pairs),
        str(contrast.ahead),
        note(contrast),
    ]


def reached_table(c: Comparison) -> Table:
    """Return the costs to reach a quality: one row per scene and arm, one column per cost."""
    groups: dict[tuple[str, str], list[Reached]] = {}
    for row in c.reached:
        groups.setdefault((row.scene, row.arm), []).append(row)
    rows = [
        [
            *(scene, c.quantity.shown(group[0].target), arm),
            *(row.cost.shown(row.median) if isfinite(row.median) else "never (\u221e)"
              for row in group),
            f"{group[-1].reached} of {len(group[-1].amounts)}",
        ]
        for (scene, arm), group in groups.items()
    ]  # fmt: skip
    columns = [Column("scene", "text"), Column(c.quantity.with_unit), _ARM]
    columns += [Column(cost.title) for cost in c.costs]
    return Table(
        [*columns, Column("reached")],
        rows,
        "Time to a quality",
        "Median over runs of the cost until the quality was first reached. A run "
        "that never reached it counts as infinite.",
    )


def settings_table(c: Comparison) -> Table:
    """Return the settings that differ between the arms, one setting per row."""
    settings = dict.fromkeys(key for arm in c.arms for key in arm.settings)
    return Table(
        [Column("setting", "text"), *(Column(arm.name, "text") for arm in c.arms)],
        [[key, *(arm.settings[key] for arm in c.arms)] for key in settings],
        "Settings that differ between the arms",
    )


def runs_table(c: Comparison) -> Table:
    """Return the table of runs that represent an arm on a scene with a seed."""

    def text(value: float | None, shown: Callable[[float], str]) -> str:
        return _NONE if value is None else shown(value)

    columns = [Column("run", "text"), _ARM, Column("scene", "text"), Column("seed")]
    columns += map(Column, ("length", *(cost.title for cost in c.costs)))
    rows = [
        [
            *(run.name, arm, scene, str(seed), run.length_text),
            *(text(run.spent(cost), cost.shown) for cost in c.costs),
            text(run.final(c.quantity.name), c.quantity.shown),
            text(run.number("primitives"), "{:,.0f}".format),
        ]
        for arm, by in c.main.items()
        for (scene, seed), run in by.items()
    ]
    columns += [Column(c.quantity.with_unit), Column("primitives")]
    return Table(columns, rows, count(len(rows), "run"))


def views_table(c: Comparison, scene: str, views: Sequence[WorstView]) -> Table:
    """Return the given held-out views of a scene as a table."""
    return Table(
        [Column("view", "text"), Column("regime", "text"), *map(Column, c.ranking)],
        [
            [
                *(view.name, view.regime),
                *(
                    c.quantity.shown(view.by_arm[arm]) if arm in view.by_arm else _NONE
                    for arm in c.ranking
                ),
            ]
            for view in views
        ],
        f"{scene}: the {len(views)} worst views",
    )


def csv_tables(c: Comparison, views: Mapping[str, Sequence[WorstView]]) -> dict[str, list[Row]]:
    """Return the rows of each CSV file in `TABLES`, by file name."""
    contrasts = list(dict.fromkeys((*c.ends, *c.equal, *c.regimes, *c.others)))
    return {
        "runs.csv": [_run(c, arm.name, run) for arm in c.arms for run in arm.runs],
        "arms.csv": [{"arm": arm.name, **arm.settings} for arm in c.arms],
        "comparisons.csv": [_contrast(contrast) for contrast in contrasts],
        "pairs.csv": [
            {**_named(contrast), "scene": pair.scene, "seed": pair.seed, "of_first": pair.first,
             "of_second": pair.second, "difference": pair.difference}
            for contrast in contrasts
            for pair in contrast.pairs
        ],
        "time_to_quality.csv": [
            {"cost": row.cost.name, "scene": row.scene, "target": row.target, "arm": row.arm,
             "seed": seed, "amount": amount}
            for row in c.reached
            for seed, amount in row.amounts.items()
        ],
        "curves.csv": _curves(c),
        "lengths.csv": [
            {"arm": point.arm, "scene": point.scene, "length": point.length, "seeds": point.seeds,
             "mean": point.mean, "deviation": point.spread, **point.spent}
            for point in c.points
        ],
        "noise.csv": [
            {"scene": scene, "deviation": deviation, "degrees_of_freedom": freedom}
            for scene, (deviation, freedom) in c.noise.items()
        ],
        "phases.csv": [{"arm": arm, **phases} for arm, phases in phases_of(c).items()],
        "views.csv": [
            {"scene": v.scene, "view": v.name, "regime": v.regime, "mean": v.mean, **v.by_arm}
            for scene_views in views.values()
            for v in scene_views
        ],
    }  # fmt: skip


def _run(c: Comparison, arm: str, run: Run) -> Row:
    row: Row = {"arm": arm, "scene": run.scene, "seed": run.seed}
    row |= {"length": run.length_text, "run": run.name}
    numbers = {cost.name: run.spent(cost) for cost in COSTS}
    numbers |= {q.name: run.final(q.name) for q in c.quantities}
    numbers |= {
        f"{q.name} {regime}": run.final(q.name, regime)
        for q in c.quantities
        for regime in run.results.regimes
    }
    numbers["primitives"] = run.number("primitives")
    numbers["peak_primitives"] = run.number("peak_primitives")
    numbers["peak_memory_mib"] = run.number("peak_memory_mib")
    row |= {key: nan if number is None else number for key, number in numbers.items()}
    return row | {key: str(run.environment.get(key) or "") for key in ("crossgrad", "commit")}


def _named(contrast: Contrast) -> Row:
    return {
        "figure": contrast.quantity.name,
        "where": contrast.where,
        "first": contrast.first,
        "second": contrast.second,
    }


def _contrast(contrast: Contrast) -> Row:
    estimate = contrast.estimate
    if estimate is None:
        return _named(contrast)
    return _named(contrast) | {
        "difference": estimate.center,
        "low_95": estimate.wide[0],
        "high_95": estimate.wide[1],
        "low_90": estimate.narrow[0],
        "high_90": estimate.narrow[1],
        "verdict": str(contrast.verdict),
        "opposed": " ".join(opposing.scene for opposing in contrast.opposed),
        "margin": contrast.quantity.margin,
        "pairs": estimate.pairs,
        "first_better": contrast.ahead,
        "scenes": estimate.scenes,
        "deviation": estimate.deviation,
        "p_different": estimate.p_different,
        "p_equivalent": estimate.p_equivalent,
        "pairs_needed": nan if estimate.needed is None else estimate.needed,
        "method": estimate.method,
        "before_the_end": "yes" if contrast.inside else "no",
    }


def _curves(c: Comparison) -> list[Row]:
    rows: list[dict[str, Any]] = []
    for cost in c.costs:
        for scene in c.scenes:
            for arm in c.main:
                at = {"cost": cost.name, "scene": scene, "arm": arm}
                points = np.stack(band(c, arm, scene, c.quantity, cost), axis=1).tolist()
                names = ("amount", "lowest", "mean", "highest")
                rows += [{**at, **dict(zip(names, point, strict=True))} for point in points]
    return rows
