"""How many runs this machine trains at a time: none shares its cores, and all fit into memory."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import floor
from pathlib import Path

from crossgrad_core.commands import UserError, available_cores, available_memory

_GIB = 2**30
#: Memory that a run needs at least, torch and kernels included.
LEAST = 3 * _GIB // 2
#: Share of the available memory that runs may take.
SHARE = 0.9
#: Linux counts here what each core did so far, and how long it is looked at, seconds.
_COUNTS, _LOOK = Path("/proc/stat"), 0.25
#: Of the counts of a core: those of doing nothing, and of waiting for a disk.
_IDLE = slice(3, 5)


@dataclass(frozen=True)
class Machine:
    """Cores and memory, divided among workers.

    Attributes:
        cores: Of each worker, the numbers of its cores.
        memory: Bytes that each may take; None where the system does not say what there is.
    """

    cores: tuple[tuple[int, ...], ...]
    memory: int | None


def divided(workers: int | None, threads: int, memory: float | None) -> Machine:
    """This machine, divided.

    Args:
        workers: Number of workers; by default as many as there are cores and memory for.
        threads: Threads of each.
        memory: GiB for each; by default an equal share of what there is.

    Raises:
        UserError: There are not so many cores, or there is not so much memory.
    """
    cores, there = available_cores(), available_memory()
    by_cores = len(cores) // threads
    if not by_cores:
        raise _too_many("--threads", f"1 to {len(cores)}", str(threads))
    usable = None if there is None else floor(SHARE * there)
    each = LEAST if memory is None else floor(memory * _GIB)
    by_memory = by_cores if usable is None else max(usable // each, memory is None)
    if not by_memory:
        raise _too_many("--memory", f"at most {(usable or 0) / _GIB:.1f}", f"{memory:g} GiB")
    most = min(by_cores, by_memory)
    count = workers or most
    if count > by_cores or (memory is not None and count > most):
        what = f"--workers with --threads {threads}"
        raise _too_many(what, f"at most {most}", str(count))
    share = None if usable is None else usable // count
    if count * threads < len(cores):
        cores = idle_first(cores)
    return Machine(
        cores=tuple(tuple(cores[n * threads : (n + 1) * threads]) for n in range(count)),
        memory=each if memory is not None else share,
    )


def idle_first(cores: Sequence[int]) -> tuple[int, ...]:
    """The cores, those first that do nothing: another sweep has taken some, perhaps."""
    with suppress(OSError, ValueError):  # Not Linux, or counts of another kind.
        before = _counts()
        time.sleep(_LOOK)
        after = _counts()
        busy = {core: _busy(before[core], after[core]) for core in before.keys() & after.keys()}
        # Halves: a core that does a little is as good as its neighbour.
        return tuple(sorted(cores, key=lambda core: (round(2.0 * busy.get(core, 0.0)), core)))
    return tuple(cores)


def _counts() -> dict[int, list[int]]:
    """Number of each core -> what it did so far, in ticks."""
    rows = (line.split() for line in _COUNTS.read_text(encoding="ascii").splitlines())
    named = ((row[0].removeprefix("cpu"), row[1:]) for row in rows if row)
    return {int(name): list(map(int, counts)) for name, counts in named if name.isdecimal()}


def _busy(before: list[int], after: list[int]) -> float:
    """Share of the time in between that a core worked."""
    ticks = [late - early for early, late in zip(before, after, strict=True)]
    return 1.0 - sum(ticks[_IDLE]) / max(1, sum(ticks))


def _too_many(where: str, expected: str, found: str) -> UserError:
    return UserError(
        "this machine has not enough cores or memory for that",
        where=where,
        expected=expected,
        found=found,
        todo="name less; runs that share a core or swap memory take longer than one after another, "
        "and their seconds mean nothing",
    )
