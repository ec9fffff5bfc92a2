"""The runs of the paper's grids by arm, and the runs that are still missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from statistics import fmean

from _asked import Asked, asked_for, of_earlier_grids, only
from _paper_data import Reading

from crossgrad_core.commands import find_runs, read_rows
from crossgrad_plugins.compare.checks import check_scenes
from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.sweep.grid import Grid, choices, scene_name

#: Rows of diagnostics.csv that combine several blocks.
JOINED = ("all", "opacities+f_dc")
PROBES, CAMERAS = "diagnostics.csv", "cameras.csv"


@dataclass(frozen=True)
class Results:
    """The runs of all grids, and the runs that are still missing.

    Attributes:
        runs: Arm -> scene and seed -> finished run.
        planned: Arm -> scenes and seeds that its grid requests.
        failed: Arm -> scenes and seeds whose run failed.
        grids: Arm -> its grid.
        left_out: Arm -> folders of runs that its grid does not request.
    """

    runs: Mapping[str, Runs]
    planned: Mapping[str, frozenset[tuple[str, int]]]
    failed: Mapping[str, frozenset[tuple[str, int]]] = field(default_factory=dict)
    grids: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)

    def missing(self, arms: Sequence[str], scenes: Sequence[str] = ()) -> tuple[int, int]:
        """Return the number of (scene, seed) pairs of the arms, and how many are missing."""
        shared = frozenset.intersection(*(self.planned.get(arm, frozenset()) for arm in arms))
        wanted = {each for each in shared if not scenes or each[0] in scenes}
        ended = {
            each
            for each in wanted
            if all(
                each in self.runs.get(arm, {}) or each in self.failed.get(arm, ()) for arm in arms
            )
        }
        return len(wanted), len(wanted) - len(ended)


def read_results(
    sweeps: Mapping[str, Path], grids: Mapping[str, Grid], assignments: Sequence[str] = ()
) -> Results:
    """Read the runs of all existing sweeps.

    Args:
        sweeps: Grid -> folder of its sweep, if it exists.
        grids: Grid -> its content.
        assignments: Texts `KEY=VALUE` with which the sweeps were started.

    Raises:
        UserError: Runs of one scene differ in views or photos, a file is damaged, or an arm has
            several configurations that its grid does not distinguish.
    """
    planned, home = {}, {}
    for name, grid in grids.items():
        pairs = frozenset((scene_name(s), seed) for s in grid.scenes for seed in grid.seeds)
        for choice in choices(grid):
            planned[choice.label], home[choice.label] = pairs, name
    places = [path for path in sweeps.values() if path.is_dir() and find_runs(path)]
    if not places:
        return Results({}, planned, grids=home)
    found = read_runs(places, skip_broken=False)
    ended = (*found.runs, *found.failed)
    cells: dict[tuple[str, str, int], list[Run]] = {}
    for run in ended:
        label = run.label or ""
        if (run.scene, run.seed) in planned.get(label, ()):
            cells.setdefault((label, run.scene, run.seed), []).append(run)
    asked = {
        (choice.label, scene_name(scene)): Asked.of(grid, choice, scene, assignments)
        for grid in grids.values()
        for choice in choices(grid)
        for scene in grid.scenes
    }
    runs, failed, left_out = _chosen(cells, asked, of_earlier_grids(ended))
    check_scenes([run for by in runs.values() for run in by.values()])
    return Results(runs, planned, failed, home, left_out)


def _chosen(
    cells: Mapping[tuple[str, str, int], Sequence[Run]],
    asked: Mapping[tuple[str, str], Asked],
    earlier: frozenset[Run],
) -> tuple[
    dict[str, dict[tuple[str, int], Run]],
    dict[str, frozenset[tuple[str, int]]],
    dict[str, tuple[Path, ...]],
]:
    """Return for each arm its requested runs, its failed runs and its other runs."""
    runs: dict[str, dict[tuple[str, int], Run]] = {}
    failed: dict[str, frozenset[tuple[str, int]]] = {}
    left_out: dict[str, tuple[Path, ...]] = {}
    for (label, scene, seed), own in cells.items():
        meant = asked_for(own, asked[label, scene], earlier)
        others = tuple(run.results.folder for run in own if run not in meant)
        if others:
            left_out[label] = (*left_out.get(label, ()), *others)
        if not meant:
            continue
        run = only(meant, label)
        if run.status == "failed":
            failed[label] = failed.get(label, frozenset()) | {(scene, seed)}
        else:
            runs.setdefault(label, {})[scene, seed] = run
    return runs, failed, left_out


def probe_rows(run: Run, file: str = PROBES) -> list[dict[str, str]]:
    """Return the table rows of the observer `diagnostics`; none without this observer."""
    path = run.results.folder / file
    if not path.is_file():
        return []
    header, *lines = read_rows(path, "the table of the probes", "repeat the run") or [[]]
    return [dict(zip(header, line, strict=True)) for line in lines]


def probed(
    run: Run, reading: Reading, rows: Sequence[Mapping[str, str]] | None = None
) -> float | None:
    """Return a statistic of a run's gradients, averaged over probes; None if missing."""
    found = [
        number(row, reading.column)
        for row in (probe_rows(run) if rows is None else rows)
        if row["metric"] == reading.metric and _is_of(row["block"], reading.block)
    ]
    known = [value for value in found if value is not None]
    return fmean(known) if known else None


def number(row: Mapping[str, str], column: str) -> float | None:
    """Return a cell as a number; None if it is empty or not finite."""
    text = row.get(column, "")
    value = float(text) if text else float("nan")
    return value if isfinite(value) else None


def _is_of(block: str, wanted: str) -> bool:
    return block not in JOINED if wanted == "each" else block == wanted
