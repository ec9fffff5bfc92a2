"""How far a sweep is while it runs: what the workers' records say, read now and then."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.layout import Layout
from crossgrad_plugins.sweep.records import Record, read_records
from crossgrad_plugins.sweep.run_status import Standing, newest_row


@dataclass(frozen=True)
class UnderWay:
    """A run under way.

    Attributes:
        job: The run.
        record: The line that says that it began.
        row: Its newest evaluation, column -> text.
    """

    job: Job
    record: Record
    row: dict[str, str]


@dataclass
class Watch:
    """The events since the sweep began.

    Attributes:
        layout: Folder of the sweep.
        before: How far all runs were.
        ended: Id of a run -> its last end since then.
        under_way: What is under way.
    """

    layout: Layout
    before: Sequence[Standing]
    ended: dict[str, Record] = field(default_factory=dict)
    under_way: tuple[UnderWay, ...] = ()
    _known: set[Record] = field(init=False)

    def __post_init__(self) -> None:
        self._known = set(read_records(self.layout.records))
        self._jobs = {each.job.id: each.job for each in self.before}
        self._begun: dict[str, Record] = {}

    def look(self) -> list[Record]:
        """Reads what is new; answers how runs ended since the last look."""
        # The clocks of several machines differ: what is new need not be the latest.
        found = [each for each in read_records(self.layout.records) if each not in self._known]
        self._known.update(found)
        new = [each for each in found if each.run in self._jobs]
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
        return [each for each in new if each.event == "ended"]

    def job(self, record: Record) -> Job:
        """The run that a record is about."""
        return self._jobs[record.run]

    @property
    def finished(self) -> int:
        """Runs that are finished, before or since."""
        return sum(
            each.state == "finished" or self._is(each.job, "finished") for each in self.before
        )

    @property
    def failed(self) -> list[Record]:
        """The last lines of runs that failed since."""
        return [each for each in self.ended.values() if each.status == "failed"]

    @property
    def left(self) -> list[Job]:
        """Runs that are neither finished nor failed since, those under way included."""
        return [
            each.job
            for each in self.before
            if each.state != "finished"
            and not (self._is(each.job, "finished") or self._is(each.job, "failed"))
        ]

    def _is(self, job: Job, status: str) -> bool:
        return job.id in self.ended and self.ended[job.id].status == status
