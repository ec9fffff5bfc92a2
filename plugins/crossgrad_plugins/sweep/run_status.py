"""How far the runs of a sweep are, read from their folders and from the workers' records."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from crossgrad_core.commands import read_rows, summary_of
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.layout import Layout
from crossgrad_plugins.sweep.records import Record

State = Literal["finished", "failed", "training", "interrupted", "waiting"]


@dataclass(frozen=True)
class Standing:
    """How far a run is.

    Attributes:
        job: The run.
        state: `interrupted` is one that began and goes on from its checkpoint.
        error: Why it failed.
        summary: The content of its summary.json, once it is finished.
    """

    job: Job
    state: State
    error: str | None = None
    summary: dict[str, Any] | None = None


def is_finished(folder: Path) -> bool:
    """Whether nothing is left to do in a run's folder."""
    return (summary_of(folder) or {}).get("status") == "finished"


def standings(
    jobs: Iterable[Job], layout: Layout, records: Sequence[Record], *, alive: bool
) -> tuple[Standing, ...]:
    """How far the runs are, in their order.

    Args:
        jobs: The runs.
        layout: The folder of the sweep.
        records: What its workers did.
        alive: Whether a sweep is under way there.
    """
    last = {record.run: record for record in records}
    return tuple(_standing(job, layout.run(job.id), last.get(job.id), alive=alive) for job in jobs)


def _standing(job: Job, folder: Path, last: Record | None, *, alive: bool) -> Standing:
    summary = summary_of(folder)
    if summary is not None and summary.get("status") == "finished":
        return Standing(job, "finished", summary=summary)
    if last is not None and last.event == "begun" and alive:
        return Standing(job, "training")
    if last is not None and last.status == "failed":
        return Standing(job, "failed", last.error)
    return Standing(job, "interrupted" if begun(folder) else "waiting")


def figures(standing: Standing) -> dict[str, float]:
    """The finite figures of all held-out views of a finished run, by name."""
    overall = (standing.summary or {}).get("overall") or {}
    numbers = ((n, v) for n, v in overall.items() if isinstance(v, int | float))
    return {name: float(value) for name, value in numbers if isfinite(value)}


def figure(standing: Standing, name: str) -> float | None:
    """A figure of all held-out views of a finished run; None where it is none or not finite."""
    return figures(standing).get(name)


def begun(folder: Path) -> bool:
    """Whether a run has a folder to go on in."""
    return (folder / "config.yaml").is_file()


def newest_row(folder: Path) -> dict[str, str]:
    """The newest evaluation of a run, column -> text; empty before the first."""
    path = folder / "metrics.csv"
    if not path.is_file():
        return {}
    rows = [row for row in read_rows(path, "the metrics", "wait", whole=True) if row]
    return dict(zip(rows[0], rows[-1], strict=False)) if len(rows) > 1 else {}
