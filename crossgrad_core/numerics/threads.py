"""The number of threads, set in one place for Numba and torch."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from crossgrad_core.errors import UserError
from crossgrad_core.system.allocator import keep_freed_memory
from crossgrad_core.system.cores import available_cores


def configure_threads(n: int | None = None) -> int:
    """Set the same number of threads for Numba's kernels and torch's operators.

    Kernels divide their work with `jobs.parallel`. For the `prange` loops of plugins, Numba's
    threading layer is set to OpenMP if it can be loaded, else TBB, else Numba's own "workqueue".
    The layer is not changed if the environment names a layer (`NUMBA_THREADING_LAYER`,
    `NUMBA_THREADING_LAYER_PRIORITY`) or if a parallel kernel has already run. Numba's number of
    threads belongs to the calling thread, so every other thread that runs kernels must also call
    this function. After the call, freed memory stays in the process (`keep_freed_memory`).

    Args:
        n: Number of threads; None uses NUMBA_NUM_THREADS or OMP_NUM_THREADS if one is set, else
            the cores available to this process (its affinity and, in a container, CPU quota).

    Returns:
        The number of threads that was set.

    Raises:
        UserError: If `n` is below 1 or above Numba's limit at its start.
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
    """Put OpenMP first among the threading layers; no effect after a layer has started."""
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
    """Run Numba and torch on one thread inside the block, for little work."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
