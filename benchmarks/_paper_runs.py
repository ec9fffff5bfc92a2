"""Runs of the paper's grids by arm, and what of them is still to come."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from statistics import fmean

from _paper_data import Reading

from crossgrad_core.commands import find_runs, read_rows
from crossgrad_plugins.compare.checks.scenes import check_scenes
from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.source import read_runs
from crossgrad_plugins.sweep.grid import Grid, choices, scene_name

#: Rows of diagnostics.csv that join blocks.
JOINED = ("all", "opacities+f_dc")
PROBES, CAMERAS = "diagnostics.csv", "cameras.csv"


@dataclass(frozen=True)
class Results:
    """The runs of all grids, and what is still to come.

    Attributes:
        runs: Arm -> scene and seed -> run, of those that finished.
        planned: Arm -> scenes and seeds that its grid has.
        failed: Arm -> scenes and seeds whose run failed.
        grids: Arm -> the grid that it belongs to.
    """

    runs: Mapping[str, Runs]
    planned: Mapping[str, frozenset[tuple[str, int]]]
    failed: Mapping[str, frozenset[tuple[str, int]]] = field(default_factory=dict)
    grids: Mapping[str, str] = field(default_factory=dict)

    def missing(self, arms: Sequence[str], scenes: Sequence[str] = ()) -> tuple[int, int]:
        """How many pairs of scene and seed the arms share by plan, and how many are to come."""
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


def read_results(sweeps: Mapping[str, Path], grids: Mapping[str, Grid]) -> Results:
    """Reads the runs of all sweeps that there are.

    Args:
        sweeps: Grid -> the folder of its sweep, which need not be there.
        grids: Grid -> its content.

    Raises:
        UserError: Runs of one scene differ in views or photos, or a file is damaged.
    """
    planned, home = {}, {}
    for name, grid in grids.items():
        pairs = frozenset((scene_name(s), seed) for s in grid.scenes for seed in grid.seeds)
        for choice in choices(grid):
            planned[choice.label], home[choice.label] = pairs, name
    places = [path for path in sweeps.values() if path.is_dir() and find_runs(path)]
    runs: dict[str, dict[tuple[str, int], Run]] = {}
    failed: dict[str, set[tuple[str, int]]] = {}
    if places:
        found = read_runs(places, skip_broken=False)
        check_scenes(found.runs)
        for run in found.runs:
            if (run.scene, run.seed) in planned.get(run.label or "", ()):
                runs.setdefault(str(run.label), {})[run.scene, run.seed] = run
        for run in found.failed:
            failed.setdefault(str(run.label), set()).add((run.scene, run.seed))
    return Results(runs, planned, {a: frozenset(each) for a, each in failed.items()}, home)


def probe_rows(run: Run, file: str = PROBES) -> list[dict[str, str]]:
    """The rows of a table of the observer `diagnostics`; none where the run did not have it."""
    path = run.results.folder / file
    if not path.is_file():
        return []
    header, *lines = read_rows(path, "the table of the probes", "repeat the run") or [[]]
    return [dict(zip(header, line, strict=True)) for line in lines]


def probed(
    run: Run, reading: Reading, rows: Sequence[Mapping[str, str]] | None = None
) -> float | None:
    """A figure of a run's gradients, averaged over its probes; None where it has none."""
    found = [
        number(row, reading.column)
        for row in (probe_rows(run) if rows is None else rows)
        if row["metric"] == reading.metric and _is_of(row["block"], reading.block)
    ]
    known = [value for value in found if value is not None]
    return fmean(known) if known else None


def number(row: Mapping[str, str], column: str) -> float | None:
    """A cell as a number; None where it is empty or not finite."""
    text = row.get(column, "")
    value = float(text) if text else float("nan")
    return value if isfinite(value) else None


def _is_of(block: str, wanted: str) -> bool:
    return block not in JOINED if wanted == "each" else block == wanted
