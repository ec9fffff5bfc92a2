"""Who carries out runs: this machine, a Ray cluster, or Slurm; each is one function.

An engine is imported when a sweep names it.
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

#: Name -> module that holds its `carry_out`.
ENGINES: Final = {
    "local": "crossgrad_plugins.sweep.engines.local",
    "ray": "crossgrad_plugins.sweep.engines.ray",
    "slurm": "crossgrad_plugins.sweep.engines.slurm",
}


@dataclass
class Stop:
    """How often the user has asked the sweep to stop.

    Attributes:
        count: So often.
    """

    count: int = 0


@dataclass(frozen=True)
class Work:
    """The arguments of an engine.

    Attributes:
        jobs: The runs in their order.
        out: Folder of the sweep, which all machines see.
        folder: Working folder of the runs, likewise.
        threads: Threads of a run.
        workers: Number of runs at a time; None leaves it to the engine.
        memory: GiB that a run may take; None leaves it to the engine.
        options: Options of the engine as the user gave them.
        machine: How this machine is divided; None for an engine that runs elsewhere.
        stop: Whether to stop.
        command: What trains a run; the numbers of cores and arguments of `crossgrad` follow.
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
        """Somebody who carries out runs of this work.

        Args:
            name: His name.
            cores: Numbers of his cores; any where there are none.
            memory: Bytes that a run of his may take; by default what the user named.
        """
        if memory is None and self.memory is not None:
            memory = int(self.memory * 2**30)
        return Worker(name, self.out, self.folder, self.threads, cores, memory, self.command)


class Engine(Protocol):
    """The function `carry_out` of an engine's module."""

    def __call__(self, work: Work) -> Iterator[None]:
        """Carries out runs; what becomes of them stands in their folders and in the records.

        Yields several times a second, so that the sweep can show how far they are. A run whose
        process or machine dies is tried again; one that fails is not. Once `work.stop.count` is
        above zero, nothing new begins and runs under way stop with a checkpoint.

        Raises:
            UserError: The engine, an option of it, or its cluster is not there; nothing was begun.
        """
        ...


def check_options(name: str, options: Iterable[str]) -> None:
    """Refuses options that an engine does not have.

    Raises:
        UserError: Names them, and those that it has.
    """
    known: tuple[str, ...] = import_module(ENGINES[name]).OPTIONS
    if unknown := sorted(set(options) - set(known)):
        raise UserError(
            f"the engine {name} has no such option"
            if known
            else f"the engine {name} has no options",
            where="--engine-option",
            expected=listed(known) if known else "",
            found=listed(unknown),
            todo="leave it out",
        )


def engine(name: str) -> Engine:
    """The engine of that name; imports its module."""
    found: Engine = import_module(ENGINES[name]).carry_out
    return found
