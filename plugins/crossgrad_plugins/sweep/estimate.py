"""How long runs are going to take, from what finished ones took."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

from crossgrad_core.commands import count
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.records import Record

#: Seconds of a run besides its training, where none has told: libraries, scene, results.
BESIDES = 12.0


@dataclass(frozen=True)
class Estimate:
    """How long some runs take, one after another.

    Attributes:
        seconds: Wall seconds of those of which something is known.
        unknown: Number of the others.
        longest: Seconds of the longest of those of which something is known.
    """

    seconds: float
    unknown: int
    longest: float = 0.0

    def text(self, at_a_time: int) -> str:
        """The estimate in words, for so many runs at a time."""
        if not self.seconds:
            return "their time is known once one has finished" if self.unknown else "nothing to do"
        known = f"about {duration(max(self.seconds / at_a_time, self.longest))}"
        unknown = f" and {count(self.unknown, 'run')} of which nothing is known yet"
        others = unknown if self.unknown else ""
        return known + others


def estimated(jobs: Sequence[Job], of: Mapping[str, Job], records: Iterable[Record]) -> Estimate:
    """How long runs take: as those of the same configuration and scene, or of the same scene.

    Args:
        jobs: The runs.
        of: Id -> run, of all that the records may be about.
        records: What workers did.
    """
    same: dict[tuple[str, ...], list[float]] = {}
    for record in records:
        if record.status == "finished" and record.seconds is not None and record.run in of:
            job = of[record.run]
            for key in ((job.scene, job.label), (job.scene,)):
                same.setdefault(key, []).append(record.seconds)
    found = [_seconds(job, same) for job in jobs]
    known = [each for each in found if each is not None]
    return Estimate(sum(known), len(found) - len(known), max(known, default=0.0))


def _seconds(job: Job, same: Mapping[tuple[str, ...], Sequence[float]]) -> float | None:
    if (job.scene, job.label) in same:
        return mean(same[job.scene, job.label])
    if job.seconds is not None:
        return job.seconds + BESIDES
    return mean(same[(job.scene,)]) if (job.scene,) in same else None


def duration(seconds: float) -> str:
    """A time for people."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.{unit == 'h':d}f} {unit}"
    return f"{seconds:.0f} s"
