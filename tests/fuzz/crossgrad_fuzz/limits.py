"""Bounds on one execution: CPU seconds and memory. Without effect where the system has none."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_STATM = Path("/proc/self/statm")
_MIB = 1 << 20


class TooSlowError(BaseException):
    """An execution took longer than it may; no parser may catch it."""


@contextmanager
def cpu_limit(seconds: float) -> Iterator[None]:
    """Raises `TooSlowError` inside after so many CPU seconds of the process.

    CPU seconds, since other work on the machine must not look like a hang.
    """
    if not hasattr(signal, "setitimer"):
        yield
        return

    def ring(number: int, frame: FrameType | None) -> None:
        raise TooSlowError

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def memory_limit(mebibytes: int) -> Iterator[None]:
    """Allocations fail inside once the address space has grown by so much."""
    if sys.platform != "linux":
        yield
        return
    import resource

    used = int(_STATM.read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + mebibytes * _MIB, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
