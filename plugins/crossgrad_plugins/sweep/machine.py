"""The number of runs at the same time on this machine.

Each run gets separate cores and enough memory.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import floor
from pathlib import Path

from crossgrad_core.commands import UserError, available_cores, available_memory

_GIB = 2**30
#: Minimum memory of a run, including torch and compiled kernels.
LEAST = 3 * _GIB // 2
#: Maximum share of the available memory that runs may use.
SHARE = 0.9
#: The file in which Linux counts clock ticks of each core, and the seconds between two readings.
_COUNTS, _LOOK = Path("/proc/stat"), 0.25
#: The fields of /proc/stat that count idle time and I/O wait.
_IDLE = slice(3, 5)


@dataclass(frozen=True)
class Machine:
    """Cores and memory of this machine, divided among workers.

    Attributes:
        cores: The core numbers of each worker.
        memory: Bytes per worker; None if the system does not report its memory.
    """

    cores: tuple[tuple[int, ...], ...]
    memory: int | None


def divided(workers: int | None, threads: int, memory: float | None) -> Machine:
    """Divide this machine among workers.

    Args:
        workers: Number of workers; by default the maximum for the available cores and memory.
        threads: Number of threads per worker.
        memory: GiB per worker; by default an equal share of the available memory.

    Raises:
        UserError: The machine has too few cores or too little memory.
    """
    cores, there = available_cores(), available_memory()
    by_cores = len(cores) // threads
    if not by_cores:
        raise _too_many("--threads", f"1 to {len(cores)}", str(threads))
    usable = None if there is None else floor(SHARE * there)
    per_worker = LEAST if memory is None else floor(memory * _GIB)
    by_memory = by_cores if usable is None else max(usable // per_worker, memory is None)
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
        memory=per_worker if memory is not None else share,
    )


def idle_first(cores: Sequence[int]) -> tuple[int, ...]:
    """Return the cores, idle cores first, because another sweep may use some cores."""
    # This fails if the system is not Linux, or if the file has another format.
    with suppress(OSError, ValueError):
        before = _counts()
        time.sleep(_LOOK)
        after = _counts()
        busy = {core: _busy(before[core], after[core]) for core in before.keys() & after.keys()}
        # Round the load of a core to one half, so that a nearly idle core counts as idle.
        return tuple(sorted(cores, key=lambda core: (round(2.0 * busy.get(core, 0.0)), core)))
    return tuple(cores)


def _counts() -> dict[int, list[int]]:
    """Return the clock ticks that each core has spent in each state, by core number."""
    rows = (line.split() for line in _COUNTS.read_text(encoding="ascii").splitlines())
    named = ((row[0].removeprefix("cpu"), row[1:]) for row in rows if row)
    return {int(name): list(map(int, counts)) for name, counts in named if name.isdecimal()}


def _busy(before: list[int], after: list[int]) -> float:
    """Return the share of time between two readings in which a core was busy."""
    ticks = [late - early for early, late in zip(before, after, strict=True)]
    return 1.0 - sum(ticks[_IDLE]) / max(1, sum(ticks))


def _too_many(where: str, expected: str, found: str) -> UserError:
    return UserError(
        "this machine does not have enough cores or memory",
        where=where,
        expected=expected,
        found=found,
        todo="lower the number; runs that share a core or swap memory take longer than "
        "runs one after another, and their times cannot be compared",
    )
