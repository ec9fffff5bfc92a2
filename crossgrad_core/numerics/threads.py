"""How many threads run, decided in one place for Numba and torch."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from crossgrad_core.errors import UserError
from crossgrad_core.system.allocator import keep_freed_memory
from crossgrad_core.system.cores import available_cores


def configure_threads(n: int | None = None) -> int:
    """Gives Numba's kernels and torch's operators the same number of threads.

    Kernels share their jobs (`jobs.share`); for the `prange` loops of plugins Numba's threading
    layer is set to OpenMP where it can be loaded, else TBB, else Numba's own "workqueue", unless
    the environment names one (`NUMBA_THREADING_LAYER`, `NUMBA_THREADING_LAYER_PRIORITY`) or a
    parallel kernel has run already. Numba's number of threads belongs to the calling thread: a
    second thread that runs kernels has to call this function too. Freed memory stays in the process
    from now on (`keep_freed_memory`).

    Args:
        n: Number of threads; None takes NUMBA_NUM_THREADS or OMP_NUM_THREADS if one is set, else
            the cores that this process may use (its affinity and, in a container, its CPU quota).

    Returns:
        The number of threads in force.

    Raises:
        UserError: If `n` is below 1 or above what Numba was started with.
    """
    import numba

    most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if n is None:
        n = min(_default_threads(), most)
    if not 1 <= n <= most:
        raise UserError(
            "number of threads out of range",
            where="threads",
            expected=f"1 to {most}",
            found=str(n),
            todo=f"say --threads {most}, or set NUMBA_NUM_THREADS={n} before the start",
        )
    _prefer_openmp()
    keep_freed_memory()
    numba.set_num_threads(n)
    torch.set_num_threads(n)
    return n


def _prefer_openmp() -> None:
    """Puts OpenMP first among the threading layers; no effect once a layer runs."""
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
    """Numba and torch on one thread inside, for work too small to wake others for."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])
