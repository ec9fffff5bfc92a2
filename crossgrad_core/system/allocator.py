"""Memory of the C library: freed memory stays in the process and uses large pages."""

import ctypes
import mmap
import sys
from functools import cache
from typing import Any, Final

#: Parameters of `mallopt` (malloc.h of glibc).
TRIM_THRESHOLD: Final = -1
TOP_PAD: Final = -2
MMAP_THRESHOLD: Final = -3
#: Maximum number of bytes of freed memory that the process keeps, and maximum size of an array on
#: the heap (the upper bound of glibc).
KEPT: Final = 512 << 20
LARGEST: Final = 32 << 20
#: Number of bytes by which the heap grows at first, and number of bytes by which it grows later.
#: The first growth is smaller than `KEPT`, so that glibc does not return this memory to the system
#: at once. glibc returns the heaps of other threads to the system only in pieces of the later size.
FIRST: Final = KEPT - 2 * LARGEST
LATER: Final = 16 << 20
#: Size of a large page in bytes, and the `madvise` constant for large pages, which the module
#: `mmap` may not define.
LARGE_PAGE: Final = 2 << 20
_HUGE: Final[int] = getattr(mmap, "MADV_HUGEPAGE", 14)


@cache
def keep_freed_memory() -> None:
    """Keep up to 512 MiB of freed memory in the process, for the arrays of the next step.

    By default, glibc returns the memory to the system after every step. The operating system would
    then clear each page again when the next step first writes to the page. Other C libraries are
    not affected.
    """
    heap = _heap()
    if heap is not None:
        heap.keep()
        use_large_pages()


def use_large_pages() -> None:
    """Request large pages for the part of the heap that is new since the previous call.

    This function works on Linux with glibc only. Steps read and write Gaussians at scattered
    positions in arrays of many megabytes. With pages of 4 KiB, most accesses miss the processor's
    table of pages (TLB). The call is only a request: the system may not support large pages, or may
    not provide any.
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
        """Keep freed memory and let the heap grow; unwritten memory uses no physical memory."""
        self._library.mallopt(TRIM_THRESHOLD, KEPT)
        self._library.mallopt(MMAP_THRESHOLD, LARGEST)
        self._library.mallopt(TOP_PAD, FIRST)
        self._library.free(self._library.malloc(LARGEST - LARGE_PAGE))
        self._library.mallopt(TOP_PAD, LATER)

    def use_large_pages(self) -> None:
        """Request large pages for the part of the heap that is new since the previous call."""
        end = self._library.sbrk(0)
        begin = -(-self._asked // LARGE_PAGE) * LARGE_PAGE
        if begin < end:
            self._library.madvise(begin, end - begin, _HUGE)
        self._asked = end


@cache
def _heap() -> _Heap | None:
    """Return the heap; None if the C library is not glibc."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return _Heap(library) if hasattr(library, "mallopt") else None
