"""Compilation of the kernels of this package, with exact IEEE arithmetic.

Without fast-math, results do not depend on optimisations of the compiler. Tests for infinity and
NaN also work correctly.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from crossgrad_core.numerics.jit import compiled, inlined

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel that Python calls; the compiled code is cached on disk."""
    return compiled(function)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that only kernels call; it becomes part of the calling kernel."""
    return inlined(function)
