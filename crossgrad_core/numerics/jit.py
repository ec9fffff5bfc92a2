"""Compile kernels with Numba.

Compiled kernels are cached on disk and release the interpreter lock.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

from crossgrad_core.numerics.kernel_cache import cache_for

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_COMPILE = cast("Callable[..., Any]", njit)
#: The flags allow fused multiply-add and ignore the sign of zero. All other arithmetic follows IEEE
#: 754 in the order of the source code. Checks for NaN and infinity therefore work.
_FLAGS = {"contract", "nsz"}


def compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compile a function that Python code calls, with options of Numba's `njit`.

    The result is cached on disk.
    """
    dispatcher = _COMPILE(**_OPTIONS, **options)(function)
    dispatcher._cache = cache_for(function)  # noqa: SLF001 - Numba has no public function for this
    return cast("Callable[P, R]", dispatcher)


def inlined(function: Callable[P, R], **options: Any) -> Callable[P, R]:  # noqa: ANN401
    """Compile a function that kernels call.

    The code of the function becomes part of the calling kernel.
    """
    # Do not compile wrappers for calls from Python and C. Such wrappers would not be used, and
    # would take a quarter of the compilation time.
    whole = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("Callable[P, R]", _COMPILE(**whole, **options, **_OPTIONS)(function))


def strict_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel with IEEE arithmetic in the order of the source code.

    The kernel runs on the calling thread.
    """
    return compiled(function)


def strict_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that strict kernels call.

    The code of the function becomes part of the calling kernel.
    """
    return inlined(function)


def strict_section(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a section of a strict kernel.

    The code of the section is inserted before the kernel is compiled.

    Functions from `strict_part` and `strict_device` are optimized separately, and again in each
    calling function. For a large function, each optimization takes seconds.
    """
    return cast("Callable[P, R]", _COMPILE(inline="always", **_OPTIONS)(function))


def strict_part(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a separate function that only strict kernels call.

    The function is not inserted into the code of its callers.
    """
    return compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel that may fuse multiplications and additions.

    The kernel runs on the calling thread.
    """
    return compiled(function, fastmath=_FLAGS)


def part(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a separate function that only kernels from `kernel` call.

    The function is not inserted into the code of its callers.
    """
    return compiled(function, fastmath=_FLAGS, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that kernels from `kernel` call.

    The code of the function becomes part of the calling kernel.
    """
    return inlined(function, fastmath=_FLAGS)


def sum_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile like `kernel`, but let sums use vector lanes.

    The machine code of the kernel determines the order of the summands.
    """
    return compiled(function, fastmath={*_FLAGS, "reassoc"})


def sum_device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with sums that kernels call.

    Sums in the function may use vector lanes, and signs of zero are preserved.
    """
    return inlined(function, fastmath={"reassoc", "contract"})
