"""How kernels are compiled: cached on disk, without the interpreter lock."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit
from numba.core.caching import FunctionCache
from typing_extensions import override

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_COMPILE = cast("Callable[..., Any]", njit)
#: Fused multiply-add may be formed and the sign of zero is free; apart from that arithmetic is IEEE
#: in the order written, so NaN and infinity stay visible.
_FLAGS = {"contract", "nsz"}
_SIMD = Path(__file__).with_name("simd.py")


@cache
def _fingerprint(folder: Path) -> str:
    digest = hashlib.sha256(_SIMD.read_bytes())
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


class _FolderCache(cast("Any", FunctionCache)):  # type: ignore[misc]
    """Numba's on-disk cache, keyed by all files of the kernel's folder and by `simd`.

    Numba itself notices changes of the file that holds a kernel, but not of the files that hold
    what the kernel inlines.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._folder = Path(function.__code__.co_filename).parent

    @override
    def _index_key(self, sig: object, codegen: object) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), _fingerprint(self._folder))


def compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compiles an entry point with options of Numba's `njit`; cached on disk."""
    dispatcher = _COMPILE(**_OPTIONS, **options)(function)
    # Without a folder to write to, neither beside the package nor in the user's cache, every
    # process compiles anew.
    with suppress(RuntimeError):
        dispatcher._cache = _FolderCache(function)  # noqa: SLF001 (Numba has no public way)
    return cast("Callable[P, R]", dispatcher)


def inlined(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compiles a function that kernels call; becomes part of the caller."""
    # Entry points for Python and C, which nobody would use, take a quarter of the compilation.
    whole = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("Callable[P, R]", _COMPILE(**whole, **options, **_OPTIONS)(function))


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that runs on one thread."""
    return compiled(function, fastmath=_FLAGS)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that such kernels call; becomes part of the caller."""
    return inlined(function, fastmath=_FLAGS)


def sum_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`; sums may be split over vector lanes (the order is fixed by the machine code)."""
    return compiled(function, fastmath={*_FLAGS, "reassoc"})


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, with `prange` loops on all of Numba's threads."""
    return compiled(function, fastmath=_FLAGS, parallel=True)
