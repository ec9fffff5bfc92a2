"""Evaluate the runs of a sweep on photos of another capture, at other distances.

    python benchmarks/distances.py runs/sweeps/GRID --of city_hybrid --on city_unimodal \
        --folders ladder mid --bands 4 --baseline ARM

The finished runs of one scene are evaluated on the views of another capture of the same place. The
runs were not trained on these views. Runs are evaluated as by `crossgrad eval RUN --on SCENE
[--file FILE]`. Finished evaluations are not repeated. A file beside each table records the scene,
the step and the PLY. The views of each folder are sorted into bands by the size of a pixel on the
visible surface, so that the table goes from near to far. Brackets in the table contain the number
of measured views. Only runs whose checkpoints exist can be evaluated.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, stdev

import numpy as np
from _elsewhere import Capture, Table, no_figure
from arms import PSNR, difference, head, read

from crossgrad_core.commands import UserError
from crossgrad_core.plugin import footprint_of
from crossgrad_plugins.compare.contrasts import contrast, judged
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run


@dataclass(frozen=True)
class Band:
    """Views of one folder at similar distances.

    Attributes:
        folder: The regime of the views.
        names: Names of the photos.
        low: Smallest size of a pixel on the visible surface in this band, in units of the scene.
        high: Largest size of a pixel on the visible surface in this band, in units of the scene.
    """

    folder: str
    names: frozenset[str]
    low: float
    high: float


def bands_of(capture: Capture, folders: Sequence[str], count: int) -> list[Band]:
    """Return the views of each folder in `count` bands of equal size, near bands first."""
    found = capture.scene
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
    """Metrics of runs on views of another capture.

    Attributes:
        runs: Arm -> scene and seed -> run.
        values: Folder of a run -> photo -> metric.
        bands: The bands of views.
        quantity: The metric.
    """

    runs: Mapping[str, Mapping[tuple[str, int], Run]]
    values: Mapping[Path, Mapping[str, float]]
    bands: Sequence[Band]
    quantity: Quantity

    def mean(self, run: Run, band: Band) -> float | None:
        """Return the mean over the measured views of a band; None without views."""
        found = self._measured(run, band)
        return fmean(found) if found else None

    def _measured(self, run: Run, band: Band) -> list[float]:
        known = self.values[run.results.folder]
        return [known[name] for name in sorted(band.names) if name in known]

    def title(self, band: Band) -> str:
        """Return a band's folder, its range of pixel sizes, and its numbers of measured views."""
        runs = [run for own in self.runs.values() for run in own.values()]
        counts = sorted({len(self._measured(run, band)) for run in runs})
        views = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        return f"{band.folder}, {band.low:.2g} to {band.high:.2g} ({views})"

    def means(self) -> Iterator[str]:
        """Yield the table of means and standard deviations over runs."""
        yield from head("arm", "runs", *map(self.title, self.bands))
        for arm, runs in self.runs.items():
            cells = (self._spread(list(runs.values()), band) for band in self.bands)
            yield f"| {arm} | {len(runs)} | {' | '.join(cells)} |"

    def _spread(self, runs: Sequence[Run], band: Band) -> str:
        means = [each for run in runs if (each := self.mean(run, band)) is not None]
        if not means:
            return ""
        return f"{fmean(means):.2f}" + (f" ± {stdev(means):.2f}" if len(means) > 1 else "")

    def against(self, baseline: str) -> Iterator[str]:
        """Yield the table of differences from one arm, with verdicts."""
        others = [arm for arm in self.runs if arm != baseline]
        table = judged(
            contrast(
                (arm, baseline),
                (self.runs[arm], self.runs[baseline]),
                self.quantity,
                partial(self.mean, band=band),
                self.title(band),
            )
            for arm in others
            for band in self.bands
        )
        found = {(each.first, each.where): each for each in table}
        titles = list(map(self.title, self.bands))
        yield from head("arm", *(f"{title}, less {baseline}" for title in titles))
        for arm in others:
            yield f"| {arm} | {' | '.join(difference(found.get((arm, at))) for at in titles)} |"


def figures_of(
    runs: Sequence[Run], capture: Capture, name: str, *, file: bool
) -> dict[Path, dict[str, float]]:
    """Return the metric of each run on each photo of the capture.

    The outer keys are the folders of the runs. The inner keys are the names of the photos. If
    `file` is True, the PLY of the run is rendered on black, else the model of the run.

    Raises:
        UserError: The metric does not exist, or a run cannot be evaluated.
    """
    measured = [
        {
            each
            for view in run.results.views
            for each, value in view.values.items()
            if value is not None
        }
        for run in runs
    ]
    if name not in (offered := set[str].intersection(*measured)):
        raise no_figure(name, sorted(offered))
    tables = [Table(run, capture, file) for run in runs]
    found = {table.run.results.folder: table.figures(name) for table in tables}
    if unmarked := sum(table.is_unmarked for table in tables):
        print(f"{unmarked} tables do not record their scene and step", file=sys.stderr)
    return found


def main() -> None:
    """Evaluate missing runs and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--of", required=True, metavar="NAME", help="scene of the runs")
    parser.add_argument("--on", type=Path, required=True, metavar="SCENE")
    parser.add_argument("--arms", nargs="+", help="only these")
    parser.add_argument("--folders", nargs="+", default=[], help="folders of SCENE; default: all")
    parser.add_argument("--bands", type=int, default=1, help="number of distance bands per folder")
    parser.add_argument("--figure", default=PSNR.name, help="a column of per_view.csv")
    parser.add_argument(
        "--files", action="store_true", help="evaluate the PLY of the runs, drawn on black"
    )
    parser.add_argument("--baseline", metavar="ARM", help="show differences from this arm")
    given = parser.parse_args()
    try:
        print_tables(given, _runs(given, parser))
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


def _runs(
    given: argparse.Namespace, parser: argparse.ArgumentParser
) -> dict[str, dict[tuple[str, int], Run]]:
    """Return the requested runs, by arm."""
    runs = {
        arm: {at: run for at, run in own.items() if at[0] == given.of}
        for arm, own in read(given.sweeps).by_arm.items()
        if not given.arms or arm in given.arms
    }
    runs = {arm: own for arm, own in runs.items() if own}
    if given.baseline is not None and given.baseline not in runs:
        parser.error(f"no arm {given.baseline}; there are {', '.join(runs) or 'none'}")
    sizes = {run.config["data"]["max_size"] for own in runs.values() for run in own.values()}
    if len(sizes) != 1:
        parser.error(f"all runs must have photos of one size; there are {sizes or 'none'}")
    return runs


def print_tables(
    given: argparse.Namespace, runs: Mapping[str, Mapping[tuple[str, int], Run]]
) -> None:
    """Evaluate missing runs and print the tables.

    Args:
        given: The options of the command line.
        runs: Arm -> scene and seed -> run, all with photos of one size.

    Raises:
        UserError: The scene cannot be read, the metric is unknown, or a run cannot be evaluated.
    """
    every = [run for own in runs.values() for run in own.values()]
    capture = Capture.read(given.on, every[0].config["data"]["max_size"])
    values = figures_of(every, capture, given.figure, file=given.files)
    bands = bands_of(capture, given.folders, given.bands)
    probes = Probes(runs, values, bands, Quantity.of(given.figure))
    print("\n".join(probes.means()))
    if given.baseline is not None:
        print()
        print("\n".join(probes.against(given.baseline)))


if __name__ == "__main__":
    main()
