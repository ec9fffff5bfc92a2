"""Jobs that threads share: each takes the next one when it is done.

A kernel takes jobs until there are none left,

    job = take(jobs)
    while job < count:
        ...
        job = take(jobs)

and `share` calls it on all threads at once. Numba's own `prange` divides the work into equal runs
beforehand and waits for every thread; with a busy or a slow core that takes longer than one thread
alone. Here a helper that did not get to run in time is simply not needed any more, and threads that
have nothing to do sleep.

What a job computes must not depend on who does it; then no bit depends on the threads.
"""
# ruff: noqa: ANN401, ARG001 - Numba's objects have no types, and it fixes the arguments.

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from typing import Any, Concatenate, ParamSpec, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from crossgrad_core.system.cores import current_core, keep_off

P = ParamSpec("P")
Jobs = NDArray[np.int64]


def _take(typing: Any, jobs: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        counter = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", counter, ir.IntType(64)(1), "monotonic")

    return types.int64(jobs), generate


#: Returns the number of the next job, counted from 0 on over all threads; only in kernels.
take = cast("Callable[[Jobs], int]", intrinsic(_take))


def share(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Calls a kernel on as many threads as Numba is set to; returns when all jobs are done."""
    jobs = np.zeros(1, np.int64)
    count = numba.get_num_threads() - 1
    call = partial(kernel, jobs, *args, **kwargs)
    helpers = _helpers(os.getpid()).ask(call, count) if count else ()
    call()
    for helper in helpers:
        if not helper.cancel():
            helper.result()


class _Helpers:
    """The helpers of a process, which run on other cores than the thread that asks them.

    Linux leaves a thread that is woken on the core of the one that woke it until it looks for cores
    with nothing to do, which takes longer than most kernels.
    """

    def __init__(self) -> None:
        self._threads: list[int] = []
        self._core: int | None = None
        most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        self._pool = ThreadPoolExecutor(most, "crossgrad-kernels", self._begin)

    def ask(self, call: Callable[[], None], count: int) -> list[Future[None]]:
        """Asks so many helpers to make a call."""
        core = current_core()
        if core != self._core:
            self._core = core
            keep_off(core, self._threads)
        return [self._pool.submit(call) for _ in range(count)]

    def _begin(self) -> None:
        self._threads.append(threading.get_native_id())
        keep_off(self._core, self._threads[-1:])


@cache
def _helpers(process: int) -> _Helpers:
    """The helpers of a process; one that was forked off has none of its parent's threads."""
    return _Helpers()


def alone(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Calls a kernel on this thread only, for work too small to wake others for; the same bits."""
    kernel(np.zeros(1, np.int64), *args, **kwargs)
