"""Set the number of threads for both Numba and torch."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from crossgrad_core.errors import UserError
from crossgrad_core.system.allocator import keep_freed_memory
from crossgrad_core.system.cores import available_cores


def configure_threads(n: int | None = None) -> int:
    """Set the number of threads for Numba's kernels and torch's operators.

    Kernels of crossgrad divide their work with `jobs.parallel`. Plugins may use `prange` loops. For
    these loops, Numba uses OpenMP if OpenMP can be loaded, else TBB, else its own "workqueue". The
    choice of the threading layer is left to the environment if `NUMBA_THREADING_LAYER` or
    `NUMBA_THREADING_LAYER_PRIORITY` is set. After the first parallel kernel, the threading layer
    cannot change any more. Numba stores the number of threads for each calling thread. Every other
    thread that runs kernels must also call this function. After the call, freed memory stays in the
    process (see `keep_freed_memory`).

    Args:
        n: Number of threads. None uses NUMBA_NUM_THREADS or OMP_NUM_THREADS if one is set, else the
            number of available cores.

    Returns:
        The number of threads that is now set.

    Raises:
        UserError: `n` is below 1, or above Numba's limit when the process started.
    """
    import numba

    most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if n is None:
        n = min(_default_threads(), most)
    if not 1 <= n <= most:
        raise UserError(
            "the number of threads is out of range",
            where="threads",
            expected=f"1 to {most}",
            found=str(n),
            todo=f"use --threads {most}, or set the environment variable NUMBA_NUM_THREADS={n} "
            "before the start",
        )
    _prefer_openmp()
    keep_freed_memory()
    numba.set_num_threads(n)
    torch.set_num_threads(n)
    return n


def _prefer_openmp() -> None:
    """Let Numba prefer OpenMP as its threading layer.

    The call has no effect after a layer has started.
    """
    import numba

    if not {"NUMBA_THREADING_LAYER", "NUMBA_THREADING_LAYER_PRIORITY"} & os.environ.keys():
        layers = ["omp", "tbb", "workqueue"]
        numba.config.THREADING_LAYER_PRIORITY = layers  # type: ignore[attr-defined]


def _default_threads() -> int:
    for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        value = os.environ.get(variable, "")
        if value.isdecimal() and int(value) > 0:
            return int(value)
    return available_cores()


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Inside the block, run Numba and torch on one thread, for small amounts of work."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
