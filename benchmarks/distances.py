"""Runs of a sweep at distances from which they have no photo: photos of another capture as truth.

    python benchmarks/distances.py runs/sweeps/GRID --of city_hybrid --on city_unimodal \
        --folders ladder mid --bands 4 --baseline ARM

Evaluates the finished runs of one scene on the views of another capture of the same place that they
were not trained on, as `crossgrad eval RUN --on SCENE [--ply FILE]` does, and skips those that have
been. The views of each folder stand in bands of distance, the size of a pixel on what they show, so
that a table reads from near to far. Only runs that kept their checkpoints can be evaluated.
"""

import argparse
import csv
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, stdev

import numpy as np
from arms import PSNR, difference, head, read

from crossgrad_core.commands import configured, read_scene
from crossgrad_core.plugin import footprint_of
from crossgrad_core.run.afterwards import How, evaluated_file, evaluated_on
from crossgrad_core.run.results.per_view import write_per_view
from crossgrad_plugins.compare.contrasts import contrast, judged
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run


@dataclass(frozen=True)
class Band:
    """Views of one folder that see about as near as each other.

    Attributes:
        folder: The regime of the views.
        names: Photos.
        low: The smallest size of a pixel on what is seen, units of the scene.
        high: The largest.
    """

    folder: str
    names: frozenset[str]
    low: float
    high: float

    @property
    def title(self) -> str:
        """Folder, sizes and number of views."""
        return f"{self.folder}, {self.low:.2g} to {self.high:.2g} ({len(self.names)})"


def bands_of(scene: Path, max_size: int, folders: Sequence[str], count: int) -> list[Band]:
    """The views of the folders, each folder in so many bands of equal numbers, near ones first."""
    reading = {"split": "none", "max_size": max_size}
    found, _ = read_scene(configured({"scene": scene, "reading": reading}))
    unit = found.similarity.scale
    bands = []
    for folder in folders or sorted({view.regime for view in found.views}):
        views = [view for view in found.views if view.regime == folder]
        sizes = {view.name: 1.0 / (unit * footprint_of(found, view)) for view in views}
        order = sorted(sizes, key=sizes.__getitem__)
        for part in np.array_split(np.array(order), min(count, len(order))):
            names = [str(name) for name in part]
            bands.append(Band(folder, frozenset(names), sizes[names[0]], sizes[names[-1]]))
    return bands


@dataclass(frozen=True)
class Probes:
    """Figures of runs on views elsewhere.

    Attributes:
        runs: Arm -> scene and seed -> run.
        values: Folder of a run -> photo -> figure.
        bands: The views.
        quantity: What the figure is.
    """

    runs: Mapping[str, Mapping[tuple[str, int], Run]]
    values: Mapping[Path, Mapping[str, float]]
    bands: Sequence[Band]
    quantity: Quantity

    def mean(self, run: Run, band: Band) -> float | None:
        """The mean over the views of a band that the run was not trained on."""
        known = self.values[run.results.folder]
        found = [known[name] for name in sorted(band.names) if name in known]
        return fmean(found) if found else None

    def means(self) -> Iterator[str]:
        """The table of means and standard deviations over runs."""
        yield from head("arm", "runs", *(band.title for band in self.bands))
        for arm, runs in self.runs.items():
            cells = (self._spread(list(runs.values()), band) for band in self.bands)
            yield f"| {arm} | {len(runs)} | {' | '.join(cells)} |"

    def _spread(self, runs: Sequence[Run], band: Band) -> str:
        means = [each for run in runs if (each := self.mean(run, band)) is not None]
        if not means:
            return ""
        return f"{fmean(means):.2f}" + (f" ± {stdev(means):.2f}" if len(means) > 1 else "")

    def against(self, baseline: str) -> Iterator[str]:
        """The table of differences from an arm, with their verdicts."""
        others = [arm for arm in self.runs if arm != baseline]
        table = judged(
            contrast(
                (arm, baseline),
                (self.runs[arm], self.runs[baseline]),
                self.quantity,
                partial(self.mean, band=band),
                band.title,
            )
            for arm in others
            for band in self.bands
        )
        found = {(each.first, each.where): each for each in table}
        titles = [band.title for band in self.bands]
        yield from head("arm", *(f"{title}, less {baseline}" for title in titles))
        for arm in others:
            yield f"| {arm} | {' | '.join(difference(found.get((arm, at))) for at in titles)} |"


def figures_of(run: Path, scene: Path, figure: str, *, file: bool) -> dict[str, float]:
    """Photo -> figure of a run's model or, drawn on black, its PLY; evaluated where it is not."""
    table = run / f"per_view_{'of_ply_' if file else ''}on_{scene.name}.csv"
    if not table.is_file():
        print(run, file=sys.stderr, flush=True)
        how = How(threads=1)
        if file:
            result = evaluated_file(run, run / "point_cloud.ply", how, scene)[0]
        else:
            result = evaluated_on(run, scene, how)[0]
        write_per_view(run, result, table.name)
    with table.open(encoding="utf-8", newline="") as lines:
        return {row["name"]: float(row[figure]) for row in csv.DictReader(lines) if row[figure]}


def main() -> None:
    """Evaluates what is missing and prints the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--of", required=True, metavar="NAME", help="scene of the runs")
    parser.add_argument("--on", type=Path, required=True, metavar="SCENE")
    parser.add_argument("--arms", nargs="+", help="only these")
    parser.add_argument("--folders", nargs="+", default=[], help="of SCENE; all by default")
    parser.add_argument("--bands", type=int, default=1, help="bands of distance per folder")
    parser.add_argument("--figure", default=PSNR.name, help="a column of per_view.csv")
    parser.add_argument("--files", action="store_true", help="their PLY on black instead")
    parser.add_argument("--baseline", metavar="ARM", help="differences from this arm")
    given = parser.parse_args()
    runs = {
        arm: {at: run for at, run in own.items() if at[0] == given.of}
        for arm, own in read(given.sweeps).by_arm.items()
        if not given.arms or arm in given.arms
    }
    runs = {arm: own for arm, own in runs.items() if own}
    if given.baseline is not None and given.baseline not in runs:
        parser.error(f"no arm {given.baseline}; there are {', '.join(runs) or 'none'}")
    folders = [run.results.folder for own in runs.values() for run in own.values()]
    sizes = {run.config["reading"]["max_size"] for own in runs.values() for run in own.values()}
    if len(sizes) != 1:
        parser.error(f"runs of one size of photos are needed; there are {sizes or 'none'}")
    values = {each: figures_of(each, given.on, given.figure, file=given.files) for each in folders}
    probes = Probes(
        runs,
        values,
        bands_of(given.on, *sizes, given.folders, given.bands),
        Quantity.of(given.figure),
    )
    print("\n".join(probes.means()))
    if given.baseline is not None:
        print()
        print("\n".join(probes.against(given.baseline)))


if __name__ == "__main__":
    main()
