"""Attempts at a run: a process watched until it ends, and tried again if it died."""

import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic, sleep
from typing import BinaryIO, Final

from crossgrad_core.commands import summary_of, write_settings, writer_of
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.run_status import Status, append, begun, is_finished

#: Seconds between two looks.
_PAUSE = 1.0
_GIB = 2**30
#: Seconds between two looks at a process.
PAUSE = 0.1
#: What trains a run; the numbers of cores and the arguments of `crossgrad` follow.
COMMAND = (sys.executable, "-m", "crossgrad_plugins.sweep.child")
#: What says how many threads a library takes.
_THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
#: Exit status of a run that was refused.
_REFUSED = 2
#: Lines of a process that are kept as the reason of its failure, at most.
_MOST_LINES = 12
#: Deaths without a new checkpoint after which a run has failed.
MOST: Final = 3
#: Seconds between two looks at a folder that another process writes into.
_WAIT = 1.0


@dataclass
class Bound:
    """Watches the memory of a process.

    Attributes:
        most: Bytes that it may take; None where there is no bound.
        taken: Bytes that it took when it was too much.
    """

    most: int | None
    taken: int = 0
    _looked: float = 0.0

    @property
    def exceeded(self) -> bool:
        """Whether it ever took too much."""
        return self.taken > 0

    @property
    def reason(self) -> str:
        """What is to be said then."""
        return (
            f"took {self.taken / _GIB:.1f} GiB, more than the {(self.most or 0) / _GIB:.1f} GiB of "
            "a run; start fewer --workers, or name more --memory"
        )

    def is_exceeded(self, process: int) -> bool:
        """Looks, once in a while, whether a process takes too much."""
        if self.most is None or monotonic() - self._looked < _PAUSE:
            return self.exceeded
        self._looked = monotonic()
        taken = resident_bytes(process)
        if taken is not None and taken > self.most:
            self.taken = taken
        return self.exceeded


def resident_bytes(process: int) -> int | None:
    """Memory that a process holds; None where the system does not say."""
    try:
        text = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return None
    for line in text.splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    return None


@dataclass(frozen=True)
class Worker:
    """Who carries out runs, one at a time.

    Attributes:
        name: Its name, which is that of its file of records.
        out: Folder of the sweep.
        folder: Working folder of its processes, which paths in settings are relative to.
        threads: Threads of a run.
        cores: Numbers of its cores; any where there are none.
        memory: Bytes that a run may take; None where there is no bound.
        command: What trains a run.
    """

    name: str
    out: Path
    folder: Path
    threads: int = 1
    cores: tuple[int, ...] = ()
    memory: int | None = None
    command: tuple[str, ...] = COMMAND


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended.

    Attributes:
        status: Whether the run is finished, and if not, why.
        error: What went wrong; empty where nothing did.
    """

    status: Status
    error: str = ""


def is_free(job: Job, worker: Worker) -> bool:
    """Whether no process writes into a run's folder, such as one of a sweep that was killed."""
    return writer_of(Layout(worker.out).run(job.id)) is None


class Attempt:
    """A process that trains a run from its beginning, or from its newest checkpoint.

    Args:
        job: The run.
        worker: Who carries it out.
    """

    def __init__(self, job: Job, worker: Worker) -> None:
        self.job = job
        self.worker = worker
        self._layout = Layout(worker.out)
        self._asked = 0
        self._start = monotonic()
        self._bound = Bound(worker.memory)
        write_settings(self._layout.settings(job.id), job.settings)
        append(self._layout.records, {"event": "begun", "run": job.id, "worker": worker.name})
        with self._layout.output(job.id).open("ab") as output:
            self._from = output.tell()
            self._process = self._started(output)

    def poll(self) -> Outcome | None:
        """How it ended; None while it is under way."""
        code = self._process.poll()
        if code is None:
            if self._bound.is_exceeded(self._process.pid) and not self._asked:
                self.stop()
            return None
        if self._process.stdin is not None:
            self._process.stdin.close()
        outcome = self._outcome(code)
        append(
            self._layout.records,
            {
                "event": "ended",
                "run": self.job.id,
                "worker": self.worker.name,
                "status": outcome.status,
                "seconds": round(monotonic() - self._start, 2),
                "error": outcome.error or None,
            },
        )
        return outcome

    def stop(self) -> None:
        """Asks the run to stop with a checkpoint; asked again, it does so faster."""
        self._asked += 1
        self._process.send_signal(signal.SIGTERM)

    def _started(self, output: BinaryIO) -> "subprocess.Popen[bytes]":
        worker = self.worker
        cores = ",".join(map(str, worker.cores)) or "-"
        return subprocess.Popen(
            [
                *worker.command,
                cores,
                *self._arguments(),
                "--threads",
                str(worker.threads),
                "--quiet",
            ],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=worker.folder,
            env={**os.environ, **dict.fromkeys(_THREADS, str(worker.threads))},
            # Ctrl-C in the terminal is for the sweep, which tells its runs.
            start_new_session=True,
        )

    def _arguments(self) -> Sequence[str]:
        folder = self._layout.run(self.job.id)
        if begun(folder):
            return ("run", "--resume", str(folder))
        settings = self._layout.settings(self.job.id)
        return ("run", "--config", str(settings), "--out", str(folder))

    def _outcome(self, code: int) -> Outcome:
        folder = self._layout.run(self.job.id)
        if is_finished(folder):
            return Outcome("finished")
        if self._bound.exceeded:
            return Outcome("failed", self._bound.reason)
        if self._asked:
            return Outcome("stopped")
        if name := _signal(code):
            return Outcome("died", f"ended by {name}")
        return Outcome("failed", self._reason(folder, code) or f"ended with exit status {code}")

    def _reason(self, folder: Path, code: int) -> str:
        """Why the run failed: what it says itself, or the end of what its process printed."""
        error = (summary_of(folder) or {}).get("error")
        # One that was refused has not touched the summary, which may be of an earlier attempt.
        if isinstance(error, str) and code != _REFUSED:
            return error
        with self._layout.output(self.job.id).open("rb") as output:
            output.seek(self._from)
            lines = output.read().decode(errors="replace").splitlines()
        first = max((n for n, line in enumerate(lines) if line.startswith("error: ")), default=None)
        return "\n".join(lines[-_MOST_LINES:] if first is None else lines[first:][:_MOST_LINES])


def _signal(code: int) -> str:
    """Name of the signal that ended a process; empty where none did."""
    number = -code if code < 0 else code - 128
    known = {each.value: each.name for each in signal.Signals}
    killed = " (by hand, or for want of memory)" if known.get(number) == "SIGKILL" else ""
    return f"{known[number]}{killed}" if number in known else ""


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


def carried_out(job: Job, worker: Worker, name: str) -> Outcome:
    """Carries out a run and waits for its end; an interrupt stops it with a checkpoint.

    A task that is repeated because its machine was lost finds what the first one left.

    Args:
        job: The run.
        worker: Who carries it out.
        name: His name.
    """
    worker = replace(worker, name=name)
    while not is_free(job, worker):
        sleep(_WAIT)
    if is_finished(Layout(worker.out).run(job.id)):
        return Outcome("finished")
    attempt = Attempt(job, worker)
    while True:
        try:
            if (outcome := attempt.poll()) is not None:
                return outcome
            sleep(PAUSE)
        except KeyboardInterrupt:
            attempt.stop()
