"""Jobs that threads share: each takes the next one when it is done.

A kernel takes jobs until there are none left,

    job = take(jobs)
    while job < count:
        ...
        job = take(jobs)

and `share` calls it on all threads at once. Numba's own `prange` divides the work into equal runs
beforehand and waits for every thread; with a busy or a slow core that takes longer than one thread
alone. Here a helper that did not get to run in time is simply not needed any more.

What a job computes must not depend on who does it; then no bit depends on the threads.
"""
# ruff: noqa: ANN401, ARG001 - Numba's objects have no types, and it fixes the arguments.

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, Concatenate, ParamSpec

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

P = ParamSpec("P")
Jobs = NDArray[np.int64]


def _take(typing: Any, jobs: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        counter = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", counter, ir.IntType(64)(1), "monotonic")

    return types.int64(jobs), generate


#: Returns the number of the next job, counted from 0 on over all threads; only in kernels.
take: Callable[[Jobs], int] = intrinsic(_take)


def share(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Calls a kernel on as many threads as Numba is set to; returns when all jobs are done."""
    jobs = np.zeros(1, np.int64)
    helpers = [
        _pool(os.getpid()).submit(kernel, jobs, *args, **kwargs)
        for _ in range(numba.get_num_threads() - 1)
    ]
    kernel(jobs, *args, **kwargs)
    for helper in helpers:
        if not helper.cancel():
            helper.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The helpers of a process; one that was forked off has none of its parent's threads."""
    return ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "crossgrad-rasterizer")
