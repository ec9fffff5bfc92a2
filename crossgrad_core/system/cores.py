"""The number of cores that this process may use, and the placement of its threads."""

import math
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

_CGROUP_LIMIT = Path("/sys/fs/cgroup/cpu.max")


def available_cores() -> int:
    """Return the number of cores in the affinity mask of the process, limited by the CPU quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(cores or 1, _quota(_CGROUP_LIMIT)))


def _quota(limit: Path) -> int:
    """Return the CPU quota of a cgroup-v2 `cpu.max` file ("quota period") in whole cores."""
    try:
        quota, period = limit.read_text(encoding="ascii").split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError):
        return os.cpu_count() or 1


def let_idle_threads_sleep() -> None:
    """Let torch's idle threads sleep, unless the environment already sets a policy.

    Otherwise, idle OpenMP threads spin for milliseconds on cores that other threads and programs
    need. The call has an effect only before torch is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def current_core() -> int | None:
    """Return the core that the calling thread runs on; None if the system does not report it."""
    tell = _sched_getcpu()
    return None if tell is None else int(tell())


def keep_off(core: int | None, threads: Iterable[int]) -> None:
    """Let threads (native ids) run on all cores that this thread may use, except `core`.

    Nothing changes if no core is left, if `core` is None, or for a thread that has ended.
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

    # Use `PyDLL`, which does not release Python's global lock, because releasing the lock takes
    # longer than this call.
    return getattr(ctypes.PyDLL(None), "sched_getcpu", None)
