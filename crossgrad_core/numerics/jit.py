"""How kernels are compiled: cached on disk, without the interpreter lock."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

from crossgrad_core.numerics.kernel_cache import cache_for

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_COMPILE = cast("Callable[..., Any]", njit)
#: Fused multiply-add may be formed and the sign of zero is free; apart from that arithmetic is IEEE
#: in the order written, so NaN and infinity stay visible.
_FLAGS = {"contract", "nsz"}


def compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compiles an entry point with options of Numba's `njit`; cached on disk."""
    dispatcher = _COMPILE(**_OPTIONS, **options)(function)
    dispatcher._cache = cache_for(function)  # noqa: SLF001 (Numba has no public way)
    return cast("Callable[P, R]", dispatcher)


def inlined(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compiles a function that kernels call; becomes part of the caller."""
    # Entry points for Python and C, which would not be used, take a quarter of the compilation.
    whole = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("Callable[P, R]", _COMPILE(**whole, **options, **_OPTIONS)(function))


def strict_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that runs on one thread: IEEE arithmetic as it is written."""
    return compiled(function)


def strict_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that strict kernels call; becomes part of the caller."""
    return inlined(function)


def strict_section(function: Callable[P, R]) -> Callable[P, R]:
    """A section of one strict kernel: its code stands in the caller before that is compiled.

    Parts and devices are optimised by themselves and again in each caller, which for large ones
    takes seconds at every level.
    """
    return cast("Callable[P, R]", _COMPILE(inline="always", **_OPTIONS)(function))


def strict_part(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function of its own that only strict kernels call."""
    return compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that runs on one thread; multiplications and additions may be fused."""
    return compiled(function, fastmath=_FLAGS)


def part(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function of its own that only such kernels call."""
    return compiled(function, fastmath=_FLAGS, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that such kernels call; becomes part of the caller."""
    return inlined(function, fastmath=_FLAGS)


def sum_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`; sums may be split over vector lanes (the order is fixed by the machine code)."""
    return compiled(function, fastmath={*_FLAGS, "reassoc"})


def sum_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles sums that kernels call, which may be split over vector lanes; signs of zero stay."""
    return inlined(function, fastmath={"reassoc", "contract"})
