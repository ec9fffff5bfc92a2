"""Engines that carry out runs: this machine, a Ray cluster, or Slurm; each engine is one function.

An engine is imported only if a sweep names it.
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

#: Name -> module with its function `carry_out`.
ENGINES: Final = {
    "local": "crossgrad_plugins.sweep.engines.local",
    "ray": "crossgrad_plugins.sweep.engines.ray",
    "slurm": "crossgrad_plugins.sweep.engines.slurm",
}


@dataclass
class Stop:
    """The stop requests of the user.

    Attributes:
        count: Number of requests.
    """

    count: int = 0


@dataclass(frozen=True)
class Work:
    """The arguments of an engine.

    Attributes:
        jobs: The runs, in order.
        out: Folder of the sweep, visible on all machines.
        folder: Working folder of the runs, visible on all machines.
        threads: Threads per run.
        workers: Number of runs in parallel; None means that the engine decides.
        memory: Maximum memory of a run, GiB; None means that the engine decides.
        options: Options of the engine as the user gave them.
        machine: The division of this machine; None for an engine that runs elsewhere.
        stop: The stop requests of the user.
        command: The command that trains a run; core numbers and arguments of `crossgrad` follow.
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
        """Return a worker that carries out runs of this work.

        Args:
            name: Name of the worker.
            cores: Numbers of the worker's cores; empty means any cores.
            memory: Maximum memory of a run in bytes; None means the limit of the user.
        """
        if memory is None and self.memory is not None:
            memory = int(self.memory * 2**30)
        return Worker(name, self.out, self.folder, self.threads, cores, memory, self.command)


class Engine(Protocol):
    """The function `carry_out` of an engine's module."""

    def __call__(self, work: Work) -> Iterator[None]:
        """Carry out runs; their folders and records hold the results.

        The function yields several times a second, so that the sweep can show its progress. A run
        whose process or machine died is tried again; a run that failed is not tried again. When
        `work.stop.count` is above zero, no run is started, and active runs stop with a checkpoint.

        Raises:
            UserError: The engine, one of its options, or its cluster is missing; no run started.
        """
        ...


def check_options(name: str, options: Iterable[str]) -> None:
    """Refuse options that an engine does not have.

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
    """Import the engine with the given name."""
    carry_out: Engine = import_module(ENGINES[name]).carry_out
    return carry_out
