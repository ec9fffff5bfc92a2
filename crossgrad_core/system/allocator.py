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
#: What stays when it is freed, bytes; and the largest array that is part of it, glibc's bound.
KEPT: Final = 512 << 20
LARGEST: Final = 32 << 20
#: What the heap grows by at first, so little that it is not given back at once, and later. The
#: heaps of other threads are given back in such pieces only.
FIRST: Final = KEPT - 2 * LARGEST
LATER: Final = 16 << 20
#: Bytes of a large page, and the advice to take them, which older headers may not have.
LARGE_PAGE: Final = 2 << 20
_HUGE: Final[int] = getattr(mmap, "MADV_HUGEPAGE", 14)


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
        """Keeps what is freed, and lets the heap grow: what is not written to costs nothing."""
        self._library.mallopt(TRIM_THRESHOLD, KEPT)
        self._library.mallopt(MMAP_THRESHOLD, LARGEST)
        self._library.mallopt(TOP_PAD, FIRST)
        self._library.free(self._library.malloc(LARGEST - LARGE_PAGE))
        self._library.mallopt(TOP_PAD, LATER)

    def use_large_pages(self) -> None:
        """Asks for them from where it ended at the last call."""
        end = self._library.sbrk(0)
        begin = -(-self._asked // LARGE_PAGE) * LARGE_PAGE
        if begin < end:
            self._library.madvise(begin, end - begin, _HUGE)
        self._asked = end


@cache
def _heap() -> _Heap | None:
    """The heap; None where the C library is another one."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return _Heap(library) if hasattr(library, "mallopt") else None
