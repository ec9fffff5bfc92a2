"""The summary of a sweep: a table of means over seeds, and the failed runs."""

from collections.abc import Iterable, Iterator, Sequence
from statistics import mean, stdev

from crossgrad_core.commands import (
    UserError,
    check_unchanged,
    drop_checksums,
    listed,
    read_rows,
    write_checksums,
    write_table,
)
from crossgrad_plugins.sweep.grid import Metric
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.run_status import Standing, figure, figures

_COLUMNS = ("run", "scene", "configuration", "seed")


def listing(cells: Iterable[Job], standings: Iterable[Standing]) -> Iterator[str]:
    """Yield one line for each combination: id, state and description."""
    state = {entry.job.id: entry for entry in standings}
    for job in cells:
        standing = state[job.id]
        error = f": {' '.join(standing.error.split())}" if standing.error else ""
        yield f"{job.id}  {standing.state:<11}  {job.title}{error}"


def table(cells: Sequence[Job], standings: Iterable[Standing], metric: Metric) -> Iterator[str]:
    """Yield a table of a metric: configurations x scenes, with mean and deviation over seeds.

    An asterisk marks the best mean of each scene. If no finished run has the metric, a line lists
    the available metrics.
    """
    all_standings = tuple(standings)
    values = {standing.job.id: figure(standing, metric.name) for standing in all_standings}
    results: dict[tuple[str, str], list[float]] = {}
    for job in cells:
        if (value := values[job.id]) is not None:
            results.setdefault((job.label, job.scene), []).append(value)
    labels = list(dict.fromkeys(job.label for job in cells))
    scenes = list(dict.fromkeys(job.scene for job in cells))
    best = {scene: _best(results, scene, metric) for scene in scenes}
    rows = [[f"{metric.name}, mean over seeds", *scenes]]
    rows += [
        [label, *(_cell(results.get((label, scene)), best[scene]) for scene in scenes)]
        for label in labels
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
    if not results and any(standing.summary for standing in all_standings):
        there = (
            listed(sorted({name for standing in all_standings for name in figures(standing)}))
            or "no figures"
        )
        yield f"no finished run has {metric.name}; the runs have {there} (`metric` of the grid)"


def _best(results: dict[tuple[str, str], list[float]], scene: str, metric: Metric) -> float | None:
    means = [mean(values) for (_, where), values in results.items() if where == scene]
    if not means:
        return None
    return max(means) if metric.goal == "maximize" else min(means)


def _cell(values: Sequence[float] | None, best: float | None) -> str:
    if not values:
        return "-"
    spread = f" ± {stdev(values):.3f}" if len(values) > 1 else ""
    mark = " *" if mean(values) == best else ""
    return f"{mean(values):.3f}{spread} ({len(values)}){mark}"


def write_plan(layout: Layout, cells: Iterable[Job]) -> None:
    """Write runs.csv, the table of runs.

    Rows of earlier grids in the folder follow at the end. A run that belongs to both grids gets its
    name in the new grid.
    """
    rows = [(job.id, job.scene, job.label, str(job.seed)) for job in cells]
    ids = {run for run, *_ in rows}
    rows += [
        (run, scene, label, seed)
        for run, scene, label, seed in _read_plan(layout, writes=True)
        if run not in ids and layout.run(run).is_dir()
    ]
    drop_checksums(layout.out)
    write_table(layout.plan, [dict(zip(_COLUMNS, row, strict=True)) for row in rows])
    write_checksums(layout.out, [layout.plan])


def earlier_rows(layout: Layout) -> frozenset[tuple[str, str]]:
    """Return run and configuration of rows in runs.csv that belong to earlier grids.

    The rows of the newest grid come first. A row belongs to an earlier grid if a row above it names
    another run of the same scene, configuration and seed. The other run need not be finished.

    Raises:
        UserError: The table cannot be read.
    """
    newest: dict[tuple[str, ...], str] = {}
    return frozenset(
        (run, label)
        for run, scene, label, seed in _read_plan(layout)
        if newest.setdefault((scene, label, seed), run) != run
    )


def _read_plan(layout: Layout, *, writes: bool = False) -> list[list[str]]:
    """Return the rows of runs.csv; empty if the table does not exist or has other columns.

    Raises:
        UserError: The table cannot be read, or a table with other columns would be overwritten.
    """
    if not layout.plan.is_file():
        return []
    check_unchanged(layout.out, [layout.plan.name], "remove it: the same sweep writes it again")
    header, *rows = read_rows(layout.plan, "the table of runs", "remove it") or [[]]
    if writes and tuple(header) != _COLUMNS:
        raise UserError(
            "the table of runs was not written by a sweep",
            where=layout.plan,
            expected=f"the columns {listed(_COLUMNS)}",
            found=listed(header),
            todo="choose another --out, or remove the table",
        )
    return [row for row in rows if len(row) == len(_COLUMNS)] if tuple(header) == _COLUMNS else []
