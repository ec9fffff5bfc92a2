"""Print tables of a sweep's arms by scene: quality, cost and commit.

    crossgrad sweep benchmarks/grids/backbones.yaml
    python benchmarks/arms.py runs/sweeps/backbones > tables.md

Values are means over seeds, with standard deviations if there are several seeds. This script does
not import torch.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev

from _asked import of_earlier_grids, only

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.checks import check_scenes
from crossgrad_plugins.compare.contrasts import Contrast, contrast, judged
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.narrative import verdict_text
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run

PSNR = Quantity.of("psnr")
#: Title of a row -> names of its regimes in the scenes. None stands for all views.
REGIMES = {"overall": (None,), "far": ("far", "aerial"), "near": ("near", "street")}
#: Key of summary.json -> title of the column.
NUMBERS = {"step": "steps", "views": "views", "primitives": "Gaussians", "cpu_seconds": "CPU s"}


@dataclass(frozen=True)
class Runs:
    """Runs by arm, scene and seed.

    If an arm has runs of several lengths, each length becomes a separate arm.
    """

    by_arm: dict[str, dict[tuple[str, int], Run]]

    @classmethod
    def read(cls, places: Sequence[Path]) -> "Runs":
        """Read all finished runs in or below the folders, without runs of earlier grids.

        Raises:
            UserError: There are no runs, a file is damaged, runs of one scene differ in views or
                photos, or an arm has several configurations with one seed.
        """
        found = read_runs(places, skip_broken=False)
        earlier = of_earlier_grids(found.runs)
        if earlier:
            print(f"{len(earlier)} runs of earlier grids are left out", file=sys.stderr)
        runs = [run for run in found.runs if run not in earlier]
        check_scenes(runs)
        lengths: dict[str, set[tuple[str, float]]] = {}
        for run in runs:
            lengths.setdefault(run.label or "", set()).add(run.length)
        cells: dict[str, dict[tuple[str, int], list[Run]]] = {}
        for run in sorted(runs, key=lambda run: (run.label or "", run.length)):
            arm = run.label or ""
            if len(lengths[arm]) > 1:
                arm = f"{arm}, {run.length_text}".removeprefix(", ")
            cells.setdefault(arm, {}).setdefault((run.scene, run.seed), []).append(run)
        return cls(
            {arm: {at: only(own, arm) for at, own in by.items()} for arm, by in cells.items()}
        )

    @property
    def scenes(self) -> list[str]:
        """Scenes of all arms, sorted."""
        return sorted({scene for runs in self.by_arm.values() for scene, _ in runs})

    def of(self, arm: str, scene: str) -> list[Run]:
        """Return the runs of an arm on a scene, by seed."""
        return [run for (at, _), run in sorted(self.by_arm.get(arm, {}).items()) if at == scene]

    def difference(self, first: str, second: str, regime: str) -> Contrast:
        """Return the PSNR of the first arm minus the PSNR of the second arm, at the end of runs."""
        runs = self.by_arm.get(first, {}), self.by_arm.get(second, {})
        return contrast((first, second), runs, PSNR, lambda run: figure(run, regime), regime)


def arms(runs: Runs, figures: Sequence[str] = (PSNR.name,)) -> Iterator[str]:
    """Yield the table of arms: quality, learning rates and cost.

    Args:
        runs: The runs.
        figures: Names of the metrics that are shown. The first metric is also shown for each
            regime.
    """
    regimes = [name for name in REGIMES if name != "overall"]
    titles = ("scene", "arm", "rates", "seeds", *figures[:1], *regimes, *figures[1:])
    yield from head(*titles, *NUMBERS.values(), "PLY, dB", "commit")
    for scene in runs.scenes:
        for arm in runs.by_arm:
            if own := runs.of(arm, scene):
                cells = " | ".join(_cells(own, figures))
                yield f"| {scene} | {arm.removesuffix(', best')} | {cells} |"


def against(runs: Runs, baseline: str) -> Iterator[str]:
    """Yield the table of differences from one arm, overall and by regime, with verdicts."""
    yield from head("arm", *(f"{each}, less {baseline}" for each in REGIMES))
    others = [arm for arm in runs.by_arm if arm != baseline]
    table = [runs.difference(arm, baseline, regime) for arm in others for regime in REGIMES]
    found = {(each.first, each.where): each for each in judged(table)}
    for arm in others:
        cells = [difference(found.get((arm, regime))) for regime in REGIMES]
        yield f"| {arm} | {' | '.join(cells)} |"


def difference(found: Contrast | None) -> str:
    """Return a difference with its interval, its verdict and its number of pairs."""
    if found is None or found.estimate is None:
        return ""
    center, (low, high) = found.estimate.center, found.estimate.wide
    return f"{center:+.2f} [{low:+.2f}, {high:+.2f}], {verdict_text(found)} ({len(found.pairs)})"


def head(*titles: str) -> Iterator[str]:
    """Yield the header lines of a table."""
    yield f"| {' | '.join(titles)} |"
    yield "|---" * len(titles) + "|"


def figure(run: Run, regime: str, name: str = PSNR.name) -> float | None:
    """Return a run's final metric in a regime of `REGIMES`; None if it is missing."""
    found = (run.final(name, each) for each in REGIMES[regime])
    return next((value for value in found if value is not None), None)


def _cells(own: Sequence[Run], figures: Sequence[str]) -> list[str]:
    factors = {run.config.get("rate_factor") for run in own}
    places = [(regime, figures[0]) for regime in REGIMES]
    places += [("overall", name) for name in figures[1:]]
    lost = [(run.summary.get("ply") or {}).get("loss") for run in own]
    commits = {str((run.summary.get("environment") or {}).get("commit")) for run in own}
    return [
        ", ".join(sorted("by length" if each is None else f"x {each:g}" for each in factors)),
        str(len(own)),
        *(_spread([figure(run, *place) for run in own]) for place in places),
        *(_number(own, name) for name in NUMBERS),
        _spread([-each for each in lost if each is not None]) or "0",
        ", ".join(sorted(commits)),
    ]


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return ""
    digits = 4 if max(map(abs, known)) <= 1.0 else 2
    mean = f"{fmean(known):.{digits}f}"
    return mean + (f" ± {stdev(known):.{digits}f}" if len(known) > 1 else "")


def _number(own: Sequence[Run], name: str) -> str:
    known = [value for run in own if (value := run.number(name)) is not None]
    return f"{fmean(known):,.0f}" if known else ""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--figures", nargs="+", default=["psnr", "ssim"], metavar="METRIC")
    parser.add_argument("--baseline", metavar="ARM", help="differences from this arm, by regime")
    given = parser.parse_args()
    runs = read(given.sweeps)
    if given.baseline is not None and given.baseline not in runs.by_arm:
        parser.error(f"no arm {given.baseline}; the arms are {', '.join(runs.by_arm)}")
    print("\n".join(arms(runs, given.figures)))
    if given.baseline is not None:
        print()
        print("\n".join(against(runs, given.baseline)))


def read(places: Sequence[Path]) -> Runs:
    """Return the runs in or below the folders. An error ends the program with one message."""
    try:
        return Runs.read(places)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
