"""The worth of the second view of a step: the tables of docs/results/two-views.md.

    crossgrad sweep benchmarks/grids/two_views_tuning.yaml
    crossgrad sweep benchmarks/grids/two_views_tuning.yaml --best benchmarks/grids/two_views.yaml
    crossgrad sweep benchmarks/grids/two_views.yaml
    python benchmarks/two_views.py runs/sweeps/two-views-best > tables.md

Each arm is there twice, at its own best factor of the learning rates on each scene and at the
published rates. Differences are paired by scene and seed; verdicts are those of
`crossgrad compare`, corrected over each table. Imports no torch.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev

from _paper_verdicts import figure_of

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.checks.scenes import check_scenes
from crossgrad_plugins.compare.contrasts import Contrast, contrast, judged
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.source import read_runs
from crossgrad_plugins.compare.statistics.verdict import Verdict
from crossgrad_plugins.compare.words import needed_text

PSNR = Quantity.of("psnr")
ONE, TWO = "one view", "two views"
#: What is held equal -> two arms, the one with two views first.
PAIRS = {
    "seconds": (f"{TWO}, equal seconds", f"{ONE}, equal seconds"),
    "views, events and count": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, stretched",
    ),
    "views, one view's schedule flat": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, flat",
    ),
    "views, statistics of one view": (
        f"{TWO}, equal views, statistics of one view",
        f"{ONE}, equal views, stretched",
    ),
    "views, statistics of two views": (
        f"{TWO}, equal views, events and count",
        f"{ONE}, equal views, statistics of an extra render",
    ),
}
#: How the two grids of rates are told apart: the title and what the names of arms end with.
RATES = {"each at its best rates": ", best", "at the published rates": ""}
#: Overall, and the regimes as scenes call them.
REGIMES = {"overall": (None,), "far": ("far", "aerial"), "near": ("near", "street")}

#: Numbers of summary.json, and what they are called.
NUMBERS = {"step": "steps", "views": "views", "primitives": "Gaussians", "cpu_seconds": "CPU s"}


@dataclass(frozen=True)
class Runs:
    """Runs by arm, scene and seed."""

    by_arm: dict[str, dict[tuple[str, int], Run]]

    @classmethod
    def read(cls, places: Sequence[Path]) -> "Runs":
        """All finished runs at or below the places."""
        found = read_runs(places, skip_broken=False)
        check_scenes(found.runs)
        by_arm: dict[str, dict[tuple[str, int], Run]] = {}
        for run in found.runs:
            by_arm.setdefault(run.label or "", {})[run.scene, run.seed] = run
        return cls(by_arm)

    @property
    def scenes(self) -> list[str]:
        """Scenes that any arm has."""
        return sorted({scene for runs in self.by_arm.values() for scene, _ in runs})

    def of(self, arm: str, scene: str) -> list[Run]:
        """The runs of an arm on a scene, by seed."""
        return [run for (at, _), run in sorted(self.by_arm.get(arm, {}).items()) if at == scene]

    def difference(self, first: str, second: str, regime: str) -> Contrast:
        """The first arm minus the second at the end of their runs."""
        runs = self.by_arm.get(first, {}), self.by_arm.get(second, {})
        return contrast((first, second), runs, PSNR, lambda run: _figure(run, regime), regime)


def differences(runs: Runs, ending: str) -> Iterator[str]:
    """The table of differences: rows by what is held equal and by regime."""
    scenes = runs.scenes
    yield from _head("two views minus one, at equal ...", "regime", *scenes, "pooled", "verdict")
    wanted = [
        (title, runs.difference(first + ending, second + ending, regime))
        for title, (first, second) in PAIRS.items()
        for regime in REGIMES
    ]
    titles = [title for title, found in wanted if found.estimate is not None]
    for title, found in zip(titles, judged(found for _, found in wanted), strict=True):
        own = [[p.difference for p in found.pairs if p.scene == scene] for scene in scenes]
        cells = [f"{fmean(each):+.2f}" if each else "" for each in own]
        yield f"| {title} | {found.where} | {' | '.join(cells)} | {pooled(found)} |"


def pooled(found: Contrast) -> str:
    """The pooled difference with its interval and its verdict, as two cells."""
    verdict = str(found.verdict)
    if found.verdict is Verdict.INCONCLUSIVE:
        verdict += f": {needed_text(found)}"
    return f"{figure_of(found)} | {verdict}"


def arms(runs: Runs) -> Iterator[str]:
    """The table of arms: how good, with which rates, at what cost."""
    yield from _head("scene", "arm", "rates", "seeds", "PSNR", "far", "near", *NUMBERS.values())
    for scene in runs.scenes:
        for arm in sorted(runs.by_arm):
            if own := runs.of(arm, scene):
                yield f"| {scene} | {arm.removesuffix(', best')} | {' | '.join(_cells(own))} |"


def _head(*titles: str) -> Iterator[str]:
    yield f"| {' | '.join(titles)} |"
    yield "|---" * len(titles) + "|"


def _cells(own: Sequence[Run]) -> list[str]:
    factors = {f"x {run.config['rate_factor']:g}" for run in own}
    return [
        ", ".join(sorted(factors)),
        str(len(own)),
        *(_spread([_figure(run, regime) for run in own]) for regime in REGIMES),
        *(_number(own, name) for name in NUMBERS),
    ]


def _figure(run: Run, regime: str) -> float | None:
    found = (run.final(PSNR.name, name) for name in REGIMES[regime])
    return next((value for value in found if value is not None), None)


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return ""
    return f"{fmean(known):.2f}" + (f" ± {stdev(known):.2f}" if len(known) > 1 else "")


def _number(own: Sequence[Run], name: str) -> str:
    known = [value for run in own if (value := run.number(name)) is not None]
    return f"{fmean(known):,.0f}" if known else ""


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", type=Path, nargs="+")
    given = parser.parse_args()
    try:
        runs = Runs.read(given.sweeps)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    for title, ending in RATES.items():
        print(f"### Two views minus one, {title}\n")
        print("\n".join(differences(runs, ending)), end="\n\n")
    print("### All arms\n")
    print("\n".join(arms(runs)))


if __name__ == "__main__":
    main()
