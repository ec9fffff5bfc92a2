"""Attempts at a run: processes that are watched until they end.

A run whose process dies is started again.
"""

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

#: Seconds between two checks of the memory of a process.
_PAUSE = 1.0
_GIB = 2**30
#: Seconds between two checks if a process has ended.
PAUSE = 0.1
#: The command that trains a run. The core numbers and the arguments of `crossgrad` are appended.
COMMAND = (sys.executable, "-m", "crossgrad_plugins.sweep.child")
#: Environment variables that limit the threads of libraries.
_THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
#: Exit status of a run whose settings were refused.
_REFUSED = 2
#: Maximum number of lines of output that are kept to explain a failure.
_MOST_LINES = 12
#: A run has failed if its process died this many times without a new checkpoint in between.
MOST: Final = 3
#: Seconds between two checks of a folder into which another process writes.
_WAIT = 1.0


@dataclass
class Bound:
    """A memory limit for a process.

    Attributes:
        most: Maximum memory in bytes; None for no limit.
        taken: Memory in bytes when the limit was exceeded; 0 before that.
    """

    most: int | None
    taken: int = 0
    _looked: float = 0.0

    @property
    def exceeded(self) -> bool:
        """True if the process has exceeded the limit."""
        return self.taken > 0

    @property
    def reason(self) -> str:
        """The message about a process that exceeded the limit."""
        return (
            f"used {self.taken / _GIB:.1f} GiB, more than the "
            f"{(self.most or 0) / _GIB:.1f} GiB of a run; start fewer --workers, or raise "
            "--memory"
        )

    def is_exceeded(self, process: int) -> bool:
        """Check at intervals if a process exceeds the limit; return True if it ever exceeded it."""
        if self.most is None or monotonic() - self._looked < _PAUSE:
            return self.exceeded
        self._looked = monotonic()
        taken = resident_bytes(process)
        if taken is not None and taken > self.most:
            self.taken = taken
        return self.exceeded


def resident_bytes(process: int) -> int | None:
    """Return the resident memory of a process in bytes; None if the system does not report it."""
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
    """A worker that executes runs, one after the other.

    Attributes:
        name: Name of the worker, and of its file of records.
        out: Folder of the sweep.
        folder: Current folder of the processes; paths in settings are relative to this folder.
        threads: Number of threads per run.
        cores: Numbers of the cores of this worker; if empty, any core is used.
        memory: Maximum memory of a run in bytes; None for no limit.
        command: The command that trains a run.
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
    """The result of an attempt.

    Attributes:
        status: `finished`, or how the attempt ended before it was finished.
        error: The error message, or an empty text.
    """

    status: Status
    error: str = ""


def is_free(job: Job, worker: Worker) -> bool:
    """Return True if no process, such as one of a killed sweep, writes into a run's folder."""
    return writer_of(Layout(worker.out).run(job.id)) is None


class Attempt:
    """A process that trains a run, from the start or from the newest checkpoint.

    Args:
        job: The run.
        worker: The worker that executes the run.
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
        """Return the outcome of the process; None while the process is running."""
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
        """Ask the run to stop with a checkpoint; a second call also skips the final evaluation."""
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
            # Start a new session, so that Ctrl-C in the terminal reaches only the sweep. The sweep
            # then stops its runs.
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
        """Return why the run failed: its own error message, or the last output of its process."""
        error = (summary_of(folder) or {}).get("error")
        # If the run was refused, do not read summary.json. A refused run writes no summary, so an
        # existing file belongs to an earlier attempt.
        if isinstance(error, str) and code != _REFUSED:
            return error
        with self._layout.output(self.job.id).open("rb") as output:
            output.seek(self._from)
            lines = output.read().decode(errors="replace").splitlines()
        first = max((n for n, line in enumerate(lines) if line.startswith("error: ")), default=None)
        return "\n".join(lines[-_MOST_LINES:] if first is None else lines[first:][:_MOST_LINES])


def _signal(code: int) -> str:
    """Return the name of the signal that ended a process; empty if no signal did."""
    number = -code if code < 0 else code - 128
    names = {member.value: member.name for member in signal.Signals}
    killed = " (by hand, or because memory was full)" if names.get(number) == "SIGKILL" else ""
    return f"{names[number]}{killed}" if number in names else ""


class Retries:
    """Counts how often the process of a run died since the run's last checkpoint.

    Args:
        out: Folder of the sweep.
    """

    def __init__(self, out: Path) -> None:
        self._layout = Layout(out)
        self._deaths = Counter[str]()
        self._reached: dict[str, str] = {}

    def once_more(self, job: Job, outcome: Outcome, worker: str = "sweep") -> bool:
        """Return True if a run must be started again after an attempt.

        If a run died too often, a record states that the run failed.
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
        error = f"{outcome.error}, {MOST} times without a new checkpoint"
        record = {"event": "ended", "run": job.id, "worker": worker}
        append(self._layout.records, {**record, "status": "failed", "error": error})
        return False

    def _newest(self, job: Job) -> str:
        """Return the newest checkpoint of a run; empty if there is none."""
        folders = self._layout.run(job.id).glob("checkpoints/step-*")
        return max((folder.name for folder in folders), default="")


def carried_out(job: Job, worker: Worker, name: str) -> Outcome:
    """Execute a run and wait for its end; an interrupt stops the run with a checkpoint.

    If a machine is lost and the task is repeated, the run continues from its files.

    Args:
        job: The run.
        worker: The worker that executes the run.
        name: Name of the worker that is written into records.
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
