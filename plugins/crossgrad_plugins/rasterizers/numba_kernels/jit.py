"""How the kernels of this package are compiled: IEEE arithmetic in the order written.

Without fast-math results do not depend on the compiler's choices, and infinities and NaN are seen
by the tests that look for them.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from crossgrad_core.numerics.jit import compiled, inlined

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles an entry point; cached on disk."""
    return compiled(function)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that kernels call; becomes part of the caller."""
    return inlined(function)
