"""Compilation of the kernels of this package, with IEEE arithmetic in the order of the source code.

Without fast-math, results do not depend on choices of the compiler. Checks for infinities and NaN
give correct results.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from crossgrad_core.numerics.jit import compiled, inlined

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile an entry point; the result is cached on disk."""
    return compiled(function)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that kernels call; the function becomes part of the calling kernel."""
    return inlined(function)
