"""Memory of the C library: what is freed stays, and lies in large pages."""

import ctypes
import mmap
import sys
from functools import cache
from typing import Any, Final

#: Parameters of `mallopt` (malloc.h of glibc).
TRIM_THRESHOLD: Final = -1
TOP_PAD: Final = -2
MMAP_THRESHOLD: Final = -3
#: What stays when it is freed and what the heap grows by, bytes; and the largest array that is
#: part of it, glibc's bound.
KEPT: Final = 512 << 20
LARGEST: Final = 32 << 20
#: Bytes of a large page.
LARGE_PAGE: Final = 2 << 20


@cache
def keep_freed_memory() -> None:
    """Keeps up to 512 MiB of freed memory in the process, for the arrays of the next step.

    By itself glibc gives them back after every step, and the kernel clears each page again when the
    next step first writes to it. Other C libraries are left as they are.
    """
    heap = _heap()
    if heap is not None:
        heap.keep()
        use_large_pages()


def use_large_pages() -> None:
    """Asks for large pages where the heap has grown since the last call; Linux with glibc only.

    Steps read and write Gaussians here and there in arrays of many megabytes. With pages of 4 KiB
    most of these need one that the processor does not have at hand. Only a request: the system may
    not know large pages, or not hand them out.
    """
    heap = _heap()
    if heap is not None:
        heap.use_large_pages()


class _Heap:
    """The heap of glibc, which grows upwards."""

    def __init__(self, library: Any) -> None:  # noqa: ANN401 - ctypes has no types
        self._library = library
        library.sbrk.argtypes, library.sbrk.restype = [ctypes.c_ssize_t], ctypes.c_void_p
        library.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        library.malloc.argtypes, library.malloc.restype = [ctypes.c_size_t], ctypes.c_void_p
        library.free.argtypes = [ctypes.c_void_p]
        self._asked = library.sbrk(0)

    def keep(self) -> None:
        """Keeps what is freed, and lets the heap grow in large pieces, for the first time now."""
        for parameter, value in (
            (TRIM_THRESHOLD, KEPT),
            (MMAP_THRESHOLD, LARGEST),
            (TOP_PAD, KEPT),
        ):
            self._library.mallopt(parameter, value)
        # Memory that nothing is written to costs nothing.
        self._library.free(self._library.malloc(LARGEST - LARGE_PAGE))

    def use_large_pages(self) -> None:
        """Asks for them from where it ended at the last call."""
        end = self._library.sbrk(0)
        begin = -(-self._asked // LARGE_PAGE) * LARGE_PAGE
        if begin < end:
            self._library.madvise(begin, end - begin, mmap.MADV_HUGEPAGE)
        self._asked = end


@cache
def _heap() -> _Heap | None:
    """The heap; None where the C library is another one."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return _Heap(library) if hasattr(library, "mallopt") else None
