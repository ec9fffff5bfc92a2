"""How the kernels of this package are compiled and cached."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit
from numba.core.caching import FunctionCache

P = ParamSpec("P")
R = TypeVar("R")

# IEEE arithmetic in the order written (no fast-math): results do not depend on the compiler's mood,
# and infinities and NaN are seen by the tests that look for them.
_OPTIONS = {"nogil": True, "error_model": "numpy"}


@cache
def _fingerprint() -> str:
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


class _PackageCache(FunctionCache):  # type: ignore[misc]
    """Numba's on-disk cache, keyed by the whole package.

    Numba itself notices changes of the file that holds a kernel, but not of the files that hold
    what the kernel inlines.
    """

    def _index_key(self, sig: object, codegen: object) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), _fingerprint())


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles an entry point; cached on disk."""
    dispatcher = njit(**_OPTIONS)(function)
    # Without a folder to write to, neither beside the package nor in the user's cache, every
    # process compiles anew.
    with suppress(RuntimeError):
        dispatcher._cache = _PackageCache(function)  # noqa: SLF001 (Numba has no public way)
    return cast("Callable[P, R]", dispatcher)


def device(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function that kernels call; becomes part of the caller."""
    # Entry points for Python and C, which nobody would use, take a quarter of the compilation.
    options = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("Callable[P, R]", njit(**options, **_OPTIONS)(function))
