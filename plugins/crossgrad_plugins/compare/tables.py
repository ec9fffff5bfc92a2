"""The tables of a comparison, as rows for CSV files."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Final

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.contrasts import Contrast
from crossgrad_plugins.compare.cost import COSTS
from crossgrad_plugins.compare.figures.curves import band
from crossgrad_plugins.compare.figures.phases import phases_of
from crossgrad_plugins.compare.pictures import WorstView

Row = dict[str, str | int | float]
#: Files of all tables.
TABLES: Final = (
    *("runs.csv", "arms.csv", "comparisons.csv", "pairs.csv", "time_to_quality.csv"),
    *("curves.csv", "lengths.csv", "noise.csv", "phases.csv", "views.csv"),
)


def tables_of(
    comparison: Comparison, views: Mapping[str, Sequence[WorstView]]
) -> dict[str, list[Row]]:
    """File name -> rows, for each of `TABLES`."""
    everything = (
        *comparison.ends, *comparison.equal, *comparison.regimes, *comparison.others,
    )  # fmt: skip
    return {
        "runs.csv": _runs(comparison),
        "arms.csv": [{"arm": arm.name, **arm.settings} for arm in comparison.arms],
        "comparisons.csv": [_contrast(each) for each in dict.fromkeys(everything)],
        "pairs.csv": _pairs(dict.fromkeys(everything)),
        "time_to_quality.csv": _reached(comparison),
        "curves.csv": _curves(comparison),
        "lengths.csv": _lengths(comparison),
        "noise.csv": [
            {"scene": scene, "deviation": deviation, "degrees_of_freedom": freedom}
            for scene, (deviation, freedom) in comparison.noise.items()
        ],
        "phases.csv": [{"arm": arm, **own} for arm, own in phases_of(comparison).items()],
        "views.csv": [
            {"scene": v.scene, "view": v.name, "regime": v.regime, "mean": v.mean, **v.by_arm}
            for own in views.values()
            for v in own
        ],
    }


def _runs(comparison: Comparison) -> list[Row]:
    rows: list[Row] = []
    for arm in comparison.arms:
        for run in arm.runs:
            row: Row = {"arm": arm.name, "scene": run.scene, "seed": run.seed}
            row |= {"length": run.length_text, "run": run.name}
            row |= {cost.name: _known(run.spent(cost)) for cost in COSTS}
            row |= {q.name: _known(run.final(q.name)) for q in comparison.quantities}
            row |= {
                f"{q.name} {regime}": _known(run.final(q.name, regime))
                for q in comparison.quantities
                for regime in run.results.regimes
            }
            row["primitives"] = _known(run.number("primitives"))
            row["peak_primitives"] = _known(run.peak_primitives)
            row["peak_memory_mib"] = _known(run.number("peak_memory_mib"))
            made_with = run.summary.get("environment") or {}
            row |= {name: str(made_with.get(name) or "") for name in ("crossgrad", "commit")}
            rows.append(row)
    return rows


def _known(value: float | None) -> float:
    return nan if value is None else value


def _contrast(contrast: Contrast) -> Row:
    row: Row = {
        "figure": contrast.quantity.name,
        "where": contrast.where,
        "first": contrast.first,
        "second": contrast.second,
    }
    found = contrast.estimate
    if found is None:
        return row
    return row | {
        "difference": found.center,
        "low_95": found.wide[0],
        "high_95": found.wide[1],
        "low_90": found.narrow[0],
        "high_90": found.narrow[1],
        "verdict": str(contrast.verdict),
        "opposed": " ".join(each.scene for each in contrast.opposed),
        "margin": contrast.quantity.margin,
        "pairs": found.pairs,
        "first_better": contrast.ahead,
        "scenes": found.scenes,
        "deviation": found.deviation,
        "p_different": found.p_different,
        "p_equivalent": found.p_equivalent,
        "pairs_needed": nan if found.needed is None else found.needed,
        "method": found.method,
        "before_the_end": "yes" if contrast.inside else "no",
    }


def _pairs(contrasts: Mapping[Contrast, None]) -> list[Row]:
    return [
        {
            "figure": each.quantity.name,
            "where": each.where,
            "first": each.first,
            "second": each.second,
            "scene": pair.scene,
            "seed": pair.seed,
            "of_first": pair.first,
            "of_second": pair.second,
            "difference": pair.difference,
        }
        for each in contrasts
        for pair in each.pairs
    ]


def _reached(comparison: Comparison) -> list[Row]:
    return [
        {
            "cost": row.cost.name,
            "scene": row.scene,
            "target": row.target,
            "arm": row.arm,
            "seed": seed,
            "amount": amount,
        }
        for row in comparison.reached
        for seed, amount in row.amounts.items()
    ]


def _curves(comparison: Comparison) -> list[Row]:
    rows: list[Row] = []
    for cost in comparison.costs:
        for scene in comparison.scenes:
            for arm, by in comparison.main.items():
                runs = [run for (at, _), run in by.items() if at == scene]
                found = band(runs, comparison.quantity, cost)
                if found is None:
                    continue
                at: Row = {"cost": cost.name, "scene": scene, "arm": arm}
                rows += [
                    {**at, "amount": x, "lowest": low, "mean": mean, "highest": high}
                    for x, low, mean, high in np.stack(found, axis=1).tolist()
                ]
    return rows


def _lengths(comparison: Comparison) -> list[Row]:
    return [
        {
            "arm": point.arm,
            "scene": point.scene,
            "length": point.length,
            "seeds": point.seeds,
            "mean": point.mean,
            "deviation": point.spread,
            **point.spent,
        }
        for point in comparison.points
    ]
