"""How often a run is tried again whose process died."""

from collections import Counter
from pathlib import Path
from typing import Final

from crossgrad_plugins.sweep.attempt import Outcome
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.layout import Layout
from crossgrad_plugins.sweep.records import append

#: Deaths without a new checkpoint after which a run has failed.
MOST: Final = 3


class Retries:
    """Counts the deaths of runs between two checkpoints.

    Args:
        out: Folder of the sweep.
    """

    def __init__(self, out: Path) -> None:
        self._layout = Layout(out)
        self._deaths = Counter[str]()
        self._reached: dict[str, str] = {}

    def once_more(self, job: Job, outcome: Outcome, worker: str = "sweep") -> bool:
        """Whether a run is to be tried again after an attempt.

        One that died too often gets a record that says that it failed.
        """
        if outcome.status != "died":
            return False
        reached = self._newest(job)
        if reached != self._reached.get(job.id):
            self._deaths[job.id] = 0
            self._reached[job.id] = reached
        self._deaths[job.id] += 1
        if self._deaths[job.id] < MOST:
            return True
        error = f"{outcome.error}, {MOST} times without a new checkpoint between"
        record = {"event": "ended", "run": job.id, "worker": worker}
        append(self._layout.records, {**record, "status": "failed", "error": error})
        return False

    def _newest(self, job: Job) -> str:
        """The newest checkpoint of a run; empty where it has none."""
        folders = self._layout.run(job.id).glob("checkpoints/step-*")
        return max((folder.name for folder in folders), default="")
