"""Engines that execute runs: this machine, a Ray cluster, or Slurm.

Each engine is one function. The module of an engine is imported only if a sweep names the engine.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Final, Protocol

from crossgrad_core.commands import UserError, listed
from crossgrad_plugins.sweep.attempt import COMMAND, Worker
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.machine import Machine

#: Name of an engine -> module with its function `carry_out`.
ENGINES: Final = {
    "local": "crossgrad_plugins.sweep.engines.local",
    "ray": "crossgrad_plugins.sweep.engines.ray",
    "slurm": "crossgrad_plugins.sweep.engines.slurm",
}


@dataclass
class Stop:
    """The user's requests to stop.

    Attributes:
        count: Number of requests.
    """

    count: int = 0


@dataclass(frozen=True)
class Work:
    """The arguments for an engine.

    Attributes:
        jobs: The runs, in order.
        out: Folder of the sweep, visible on all machines.
        folder: Current folder of the runs, visible on all machines.
        threads: Number of threads per run.
        workers: Number of runs at the same time; None lets the engine choose.
        memory: Maximum memory of a run, GiB; None lets the engine choose.
        options: Options of the engine as the user gave them.
        machine: Cores and memory of each worker on this machine; None for an engine on other
            machines.
        stop: The user's requests to stop.
        command: The command that trains a run; core numbers and the arguments of `crossgrad` are
            appended.
    """

    jobs: Sequence[Job]
    out: Path
    folder: Path
    threads: int
    workers: int | None = None
    memory: float | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    machine: Machine | None = None
    stop: Stop = field(default_factory=Stop)
    command: tuple[str, ...] = COMMAND

    def worker(self, name: str, cores: tuple[int, ...] = (), memory: int | None = None) -> Worker:
        """Return a worker that executes runs.

        Args:
            name: Name of the worker.
            cores: Numbers of the cores of this worker; if empty, any core is used.
            memory: Maximum memory of a run in bytes; None for the user's limit.
        """
        if memory is None and self.memory is not None:
            memory = int(self.memory * 2**30)
        return Worker(name, self.out, self.folder, self.threads, cores, memory, self.command)


class Engine(Protocol):
    """The type of the function `carry_out` in the module of an engine."""

    def __call__(self, work: Work) -> Iterator[None]:
        """Execute runs; their folders and records contain the results.

        The function yields several times per second, so that the sweep can show its progress. A run
        is started again if its process or machine died. It is not started again if it failed. After
        `work.stop.count` becomes positive, no run is started, and active runs stop with a
        checkpoint.

        Raises:
            UserError: The engine, its cluster or one of its options is missing; no run was started.
        """
        ...


def check_options(name: str, options: Iterable[str]) -> None:
    """Refuse options that the engine does not have.

    Raises:
        UserError: An option is unknown; the message lists unknown and known options.
    """
    known: tuple[str, ...] = import_module(ENGINES[name]).OPTIONS
    if unknown := sorted(set(options) - set(known)):
        raise UserError(
            f"the engine {name} does not have this option"
            if known
            else f"the engine {name} has no options",
            where="--engine-option",
            expected=listed(known) if known else "",
            found=listed(unknown),
            todo="leave the option out",
        )


def engine(name: str) -> Engine:
    """Import the engine with a given name."""
    carry_out: Engine = import_module(ENGINES[name]).carry_out
    return carry_out
