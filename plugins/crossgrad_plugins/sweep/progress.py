"""The progress of a sweep on the screen, and its estimated time."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from shutil import get_terminal_size
from statistics import mean
from time import monotonic
from typing import Final

from crossgrad_core.commands import controls_of, count, is_live, one_line
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.run_status import Record, Standing, newest_row, read_records

#: Seconds between two readings of the records, and maximum number of failures in the live table.
PAUSE: Final = 1.0
MOST_FAILURES: Final = 8
#: Assumed number of seconds that a run needs besides training: to load libraries and the scene, and
#: to write results.
BESIDES = 12.0


@dataclass(frozen=True)
class UnderWay:
    """A run that is active now.

    Attributes:
        job: The run.
        record: The record of the start of the run.
        row: The newest evaluation of the run: column -> text.
    """

    job: Job
    record: Record
    row: dict[str, str]


@dataclass
class Watch:
    """The events of a sweep since its start.

    Attributes:
        layout: Folder of the sweep.
        before: State of each run at the start of the sweep.
        ended: Id of a run -> its newest record of an end since the start of the sweep.
        under_way: The active runs.
    """

    layout: Layout
    before: Sequence[Standing]
    ended: dict[str, Record] = field(default_factory=dict)
    under_way: tuple[UnderWay, ...] = ()
    _known: set[Record] = field(init=False)

    def __post_init__(self) -> None:
        self._known = set(read_records(self.layout.records))
        self._jobs = {standing.job.id: standing.job for standing in self.before}
        self._begun: dict[str, Record] = {}

    def look(self) -> list[Record]:
        """Read new records; return the records of runs that ended since the last call."""
        # Compare records with known records and not by time. The clocks of machines differ, so a
        # new record may have an earlier time.
        unread = [entry for entry in read_records(self.layout.records) if entry not in self._known]
        self._known.update(unread)
        new = [entry for entry in unread if entry.run in self._jobs]
        for record in new:
            if record.event == "begun":
                self._begun[record.run] = record
            else:
                self._begun.pop(record.run, None)
                self.ended[record.run] = record
        self.under_way = tuple(
            UnderWay(self._jobs[run], record, newest_row(self.layout.run(run)))
            for run, record in self._begun.items()
        )
        return [entry for entry in new if entry.event == "ended"]

    def job(self, record: Record) -> Job:
        """Return the run of a record."""
        return self._jobs[record.run]

    @property
    def finished(self) -> int:
        """Number of finished runs, including runs that were finished before this sweep started."""
        return sum(
            standing.state == "finished" or self._is(standing.job, "finished")
            for standing in self.before
        )

    @property
    def failed(self) -> list[Record]:
        """The last records of runs that failed since the sweep started."""
        return [record for record in self.ended.values() if record.status == "failed"]

    @property
    def left(self) -> list[Job]:
        """The runs that are neither finished nor failed, including active runs."""
        return [
            standing.job
            for standing in self.before
            if standing.state != "finished"
            and not (self._is(standing.job, "finished") or self._is(standing.job, "failed"))
        ]

    def _is(self, job: Job, status: str) -> bool:
        return job.id in self.ended and self.ended[job.id].status == status


class Screen:
    """Shows a sweep on stderr.

    Args:
        watch: The events of the sweep.
        at_a_time: Number of runs at the same time.
    """

    def __init__(self, watch: Watch, at_a_time: int) -> None:
        self._watch = watch
        self._at_a_time = at_a_time
        self._live = is_live(sys.stderr)
        self._lines = 0
        self._last = 0.0

    def show(self, *, at_once: bool = False) -> None:
        """Read the records and show new events, at most once per second."""
        if monotonic() - self._last < PAUSE and not at_once:
            return
        self._last = monotonic()
        ends = self._watch.look()
        if self._live:
            self._draw([*self._table(), *self._failures()])
        else:
            for record in ends:
                _write(f"... {one_line(self._end(record))}\n")

    def close(self) -> None:
        """Show the final state; a live table stays on the screen."""
        self.show(at_once=True)

    def _draw(self, lines: list[str]) -> None:
        width = get_terminal_size().columns
        up = f"\x1b[{self._lines}F" if self._lines else ""
        shown = "".join(f"\x1b[K{one_line(line)[: width - 1]}\n" for line in lines)
        _write(f"{up}{shown}\x1b[J")
        self._lines = len(lines)

    def _table(self) -> list[str]:
        watch = self._watch
        total, left = len(watch.before), len(watch.left)
        jobs = {standing.job.id: standing.job for standing in watch.before}
        time = estimated(watch.left, jobs, read_records(watch.layout.records))
        counts = f"{watch.finished} of {total} finished, {len(watch.failed)} failed, {left} left"
        return [f"{counts}; {time.text(self._at_a_time)}", *map(_line, watch.under_way)]

    def _failures(self) -> list[str]:
        failed = self._watch.failed
        shown = [f"  failed: {self._end(record)}" for record in failed[-MOST_FAILURES:]]
        more = len(failed) - len(shown)
        return [*([f"  {more} earlier failures"] if more else []), *shown]

    def _end(self, record: Record) -> str:
        """Return a line about the end of a run."""
        watch = self._watch
        took = "" if record.seconds is None else f" after {duration(record.seconds)}"
        reason = f": {' '.join((record.error or '').split())}" if record.error else ""
        count = f"{watch.finished} of {len(watch.before)}"
        return f"{count}  {watch.job(record).title}: {record.status}{took}{reason}"


def _line(active: UnderWay) -> str:
    passed = duration((datetime.now(UTC) - active.record.when).total_seconds())
    cells = [f"{name} {active.row[name][:7]}" for name in ("step", "psnr") if active.row.get(name)]
    return f"  {active.record.worker:>8}  {active.job.title}  {passed}  {'  '.join(cells)}".rstrip()


def _write(text: str) -> None:
    stream = controls_of(sys.stderr)
    stream.write(text)
    stream.flush()


@dataclass(frozen=True)
class Estimate:
    """The estimated time of runs that are executed one after another.

    Attributes:
        seconds: Wall-clock seconds of the runs with an estimate.
        unknown: Number of runs without an estimate.
        longest: Wall-clock seconds of the longest run with an estimate.
    """

    seconds: float
    unknown: int
    longest: float = 0.0

    def text(self, at_a_time: int) -> str:
        """Return the estimate as text, for `at_a_time` runs at the same time."""
        if not self.seconds:
            return (
                "the time is known after the first finished run"
                if self.unknown
                else "nothing to do"
            )
        estimate = f"about {duration(max(self.seconds / at_a_time, self.longest))}"
        unknown = f"; the time of {count(self.unknown, 'run')} is not known yet"
        others = unknown if self.unknown else ""
        return estimate + others


def estimated(jobs: Sequence[Job], of: Mapping[str, Job], records: Iterable[Record]) -> Estimate:
    """Estimate the time of runs from finished runs of the same configuration and scene.

    If there are none, the time limit of the run is used, or else finished runs of the same scene.

    Args:
        jobs: The runs.
        of: Id -> run, for all runs that records may belong to.
        records: The records of the workers.
    """
    same: dict[tuple[str, ...], list[float]] = {}
    for record in records:
        if record.status == "finished" and record.seconds is not None and record.run in of:
            job = of[record.run]
            for key in ((job.scene, job.label), (job.scene,)):
                same.setdefault(key, []).append(record.seconds)
    estimates = [_seconds(job, same) for job in jobs]
    known = [seconds for seconds in estimates if seconds is not None]
    return Estimate(sum(known), len(estimates) - len(known), max(known, default=0.0))


def _seconds(job: Job, same: Mapping[tuple[str, ...], Sequence[float]]) -> float | None:
    if (job.scene, job.label) in same:
        return mean(same[job.scene, job.label])
    if job.seconds is not None:
        return job.seconds + BESIDES
    return mean(same[(job.scene,)]) if (job.scene,) in same else None


def duration(seconds: float) -> str:
    """Return a duration as text, such as minutes and seconds."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.{unit == 'h':d}f} {unit}"
    return f"{seconds:.0f} s"
