"""Compilation of kernels: cached on disk, without the interpreter lock."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

from crossgrad_core.numerics.kernel_cache import cache_for

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_COMPILE = cast("Callable[..., Any]", njit)
#: Allow fused multiply-add and ignore the sign of zero. All other arithmetic follows IEEE 754 in
#: the order of the source code, so NaN and infinity stay visible.
_FLAGS = {"contract", "nsz"}


def compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compile an entry point with options of Numba's `njit`; cached on disk."""
    dispatcher = _COMPILE(**_OPTIONS, **options)(function)
    dispatcher._cache = cache_for(function)  # noqa: SLF001 - Numba has no public function for this
    return cast("Callable[P, R]", dispatcher)


def inlined(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compile a function that kernels call; it becomes part of the caller."""
    # Do not compile entry points for Python and C, which are not used and take a quarter of the
    # compilation time.
    whole = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("Callable[P, R]", _COMPILE(**whole, **options, **_OPTIONS)(function))


def strict_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that runs on one thread with IEEE arithmetic in the written order."""
    return compiled(function)


def strict_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that strict kernels call; it becomes part of the caller."""
    return inlined(function)


def strict_section(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a section of one strict kernel; its code is inserted before the caller is compiled.

    Functions from `strict_part` and `strict_device` are optimised separately, and again in each
    caller. For large functions, each optimisation takes seconds.
    """
    return cast("Callable[P, R]", _COMPILE(inline="always", **_OPTIONS)(function))


def strict_part(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a separate function that only strict kernels call."""
    return compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that runs on one thread; multiplications and additions may be fused."""
    return compiled(function, fastmath=_FLAGS)


def part(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a separate function that only functions from `kernel` call."""
    return compiled(function, fastmath=_FLAGS, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that functions from `kernel` call; it becomes part of the caller."""
    return inlined(function, fastmath=_FLAGS)


def sum_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile like `kernel`; sums may use vector lanes, in an order that the machine code fixes."""
    return compiled(function, fastmath={*_FLAGS, "reassoc"})


def sum_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile sums that kernels call; they may use vector lanes and keep signs of zero."""
    return inlined(function, fastmath={"reassoc", "contract"})
