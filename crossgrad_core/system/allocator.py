"""Memory that the C library would hand back to the system."""

import ctypes
import sys
from functools import cache
from typing import Final

#: Parameters of `mallopt` (malloc.h of glibc).
TRIM_THRESHOLD: Final = -1
MMAP_THRESHOLD: Final = -3
#: What stays when it is freed, bytes; and the largest array that is part of it, glibc's bound.
KEPT: Final = 512 << 20
LARGEST: Final = 32 << 20


@cache
def keep_freed_memory() -> None:
    """Keeps up to 512 MiB of freed memory in the process, for the arrays of the next step.

    By itself glibc gives them back after every step, and the kernel clears each page again when the
    next step first writes to it. Other C libraries are left as they are.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(MMAP_THRESHOLD, LARGEST)
