"""How many cores this process may use, and which of them a thread does."""

import math
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

_CGROUP_LIMIT = Path("/sys/fs/cgroup/cpu.max")


def available_cores() -> int:
    """Cores this process may use: its affinity, at most its container's CPU quota rounded up."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(cores or 1, _quota(_CGROUP_LIMIT)))


def _quota(limit: Path) -> int:
    """CPU quota of a cgroup-v2 `cpu.max` file ("quota period" or "max period"), in whole cores."""
    try:
        quota, period = limit.read_text(encoding="ascii").split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError):
        return os.cpu_count() or 1


def let_idle_threads_sleep() -> None:
    """Lets torch's threads sleep when they have nothing to do, unless the environment says more.

    OpenMP's threads spin for milliseconds on cores that other threads of a step wait for, ours and
    those of other programs. Heard only before torch is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def current_core() -> int | None:
    """Number of the core that the calling thread runs on; None where the system does not tell."""
    tell = _sched_getcpu()
    return None if tell is None else int(tell())


def keep_off(core: int | None, threads: Iterable[int]) -> None:
    """Lets threads (native numbers) run on all cores that this thread may use but `core`.

    Nothing changes where that leaves none, where `core` is None, or for a thread that has ended.
    """
    if core is None:
        return
    others = os.sched_getaffinity(0) - {core}
    for thread in threads if others else ():
        with suppress(ProcessLookupError):
            os.sched_setaffinity(thread, others)


@cache
def _sched_getcpu() -> Callable[[], int] | None:
    if sys.platform != "linux":
        return None
    import ctypes

    # The lock is kept: the call takes less than letting it go does.
    return getattr(ctypes.PyDLL(None), "sched_getcpu", None)
