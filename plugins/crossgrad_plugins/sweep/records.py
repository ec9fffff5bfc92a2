"""Records of workers: one append-only file of JSON lines for each, readable whatever ended them."""

import json
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from crossgrad_core.commands import disk_errors

#: How an attempt at a run ended: `stopped` by the sweep, `died` by anything else that left it
#: unfinished without an error of its own.
Status = Literal["finished", "failed", "stopped", "died"]


@dataclass(frozen=True)
class Record:
    """A line.

    Attributes:
        event: An attempt at a run began, or ended.
        run: Id of the run.
        worker: Name of the worker.
        time: UTC, ISO 8601.
        host: Name of the machine.
        status: How it ended; None of one that began.
        seconds: Wall seconds that it took.
        error: What went wrong.
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
        """When it was written."""
        return datetime.fromisoformat(self.time)


def append(folder: Path, record: Mapping[str, Any]) -> None:
    """Adds a line to a worker's file; time and machine are added to what is given.

    Args:
        folder: Where the files of workers are.
        record: The fields of a `Record` besides those.

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
        # Begins with a line end where somebody was killed in the middle of a line.
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
    """The lines of all workers in the order of time; torn and foreign ones are left out."""
    paths = sorted(folder.glob("*.jsonl"))
    return sorted((each for path in paths for each in _lines(path)), key=lambda each: each.time)


def _lines(path: Path) -> Iterator[Record]:
    for line in path.read_bytes().splitlines():
        try:
            record = Record(**json.loads(line))
            _ = record.when
        except (TypeError, ValueError):
            continue
        yield record
