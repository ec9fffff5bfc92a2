"""The states of a sweep's runs, from their folders and from the records of workers."""

import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from crossgrad_core.commands import disk_errors, read_rows, summary_of
from crossgrad_plugins.sweep.job import Job, Layout

State = Literal["finished", "failed", "training", "interrupted", "waiting"]
#: How an attempt ended: `stopped` if the sweep stopped it, `died` if it ended without an error
#: message.
Status = Literal["finished", "failed", "stopped", "died"]


@dataclass(frozen=True)
class Standing:
    """The state of a run.

    Attributes:
        job: The run.
        state: The state. An `interrupted` run has started, and continues from its checkpoint.
        error: The reason why the run failed.
        summary: Content of summary.json if the run is finished.
    """

    job: Job
    state: State
    error: str | None = None
    summary: dict[str, Any] | None = None


def is_finished(folder: Path) -> bool:
    """Return True if the folder contains a finished run."""
    return (summary_of(folder) or {}).get("status") == "finished"


@dataclass(frozen=True)
class Record:
    """A line in the file of a worker.

    Attributes:
        event: `begun` for the start of an attempt, `ended` for its end.
        run: Id of the run.
        worker: Name of the worker.
        time: Time in UTC, ISO 8601.
        host: Name of the machine.
        status: How the attempt ended; None at its start.
        seconds: Wall-clock seconds of the attempt.
        error: The error message.
    """

    event: Literal["begun", "ended"]
    run: str
    worker: str
    time: str
    host: str
    status: Status | None = None
    seconds: float | None = None
    error: str | None = None

    @property
    def when(self) -> datetime:
        """The time of the record."""
        return datetime.fromisoformat(self.time)


def standings(
    jobs: Iterable[Job], layout: Layout, records: Sequence[Record], *, alive: bool
) -> tuple[Standing, ...]:
    """Return the state of each run, in the order of the runs.

    Args:
        jobs: The runs.
        layout: The folder of the sweep.
        records: The records of the workers.
        alive: True if a sweep process works in the folder.
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
    """Return the finite metrics of a finished run over all held-out views, by name."""
    overall = (standing.summary or {}).get("overall") or {}
    numbers = ((n, v) for n, v in overall.items() if isinstance(v, int | float))
    return {name: float(value) for name, value in numbers if isfinite(value)}


def figure(standing: Standing, name: str) -> float | None:
    """Return a metric of a finished run over all held-out views; None if missing or not finite."""
    return figures(standing).get(name)


def begun(folder: Path) -> bool:
    """Return True if the folder of a run exists, so that the run can continue."""
    return (folder / "config.yaml").is_file()


def newest_row(folder: Path) -> dict[str, str]:
    """Return the newest evaluation of a run: column -> text.

    The result is empty before the first evaluation.
    """
    path = folder / "metrics.csv"
    if not path.is_file():
        return {}
    rows = [row for row in read_rows(path, "the metrics", "wait", whole=True) if row]
    return dict(zip(rows[0], rows[-1], strict=False)) if len(rows) > 1 else {}


def append(folder: Path, record: Mapping[str, Any]) -> None:
    """Append a record with time and machine to the file of a worker.

    Args:
        folder: Folder of the record files.
        record: The fields of a `Record` without time and machine.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    line = asdict(Record(**{"time": now, "host": platform.node(), **record}))
    content = json.dumps({name: value for name, value in line.items() if value is not None})
    path = folder / f"{record['worker']}.jsonl"
    with disk_errors(path):
        _add(path, content)


def _add(path: Path, content: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        # Start with a line break, because a killed process may have left an incomplete line.
        os.write(descriptor, (("" if _is_whole(path) else "\n") + content + "\n").encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_whole(path: Path) -> bool:
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 1))
        return file.read() in {b"", b"\n"}


def read_records(folder: Path) -> list[Record]:
    """Read the records of all workers, ordered by time.

    Incomplete or invalid lines are skipped.
    """
    paths = sorted(folder.glob("*.jsonl"))
    return sorted(
        (record for path in paths for record in _lines(path)), key=lambda record: record.time
    )


def _lines(path: Path) -> Iterator[Record]:
    for line in path.read_bytes().splitlines():
        try:
            record = Record(**json.loads(line))
            _ = record.when
        except (TypeError, ValueError):
            continue
        yield record
