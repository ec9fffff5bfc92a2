"""How the core's kernels are compiled: cached on disk, without the interpreter lock.

Fused multiply-add may be formed and the sign of zero is free; apart from that arithmetic is IEEE in
the order written, so NaN and infinity stay visible.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")

_FLAGS = {"contract", "nsz"}
_COMPILE = cast("Callable[..., Any]", njit)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that runs on one thread."""
    return _compiled(function, _FLAGS)


def sum_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`; sums may be split over vector lanes (the order is fixed by the machine code)."""
    return _compiled(function, {*_FLAGS, "reassoc"})


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, with `prange` loops on all of Numba's threads."""
    return _compiled(function, _FLAGS, parallel=True)


def _compiled(
    function: Callable[P, R], flags: set[str], *, parallel: bool = False
) -> Callable[P, R]:
    options = {"nogil": True, "error_model": "numpy", "fastmath": flags, "parallel": parallel}
    return cast("Callable[P, R]", _COMPILE(cache=True, **options)(function))
