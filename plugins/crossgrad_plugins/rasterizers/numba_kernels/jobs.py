"""Jobs that the threads of a kernel share: whoever is free takes the next one.

Numba divides a `prange` into equal runs beforehand, so the slowest thread (a busy core, a slow
one) decides. A kernel instead starts one worker per thread, and each takes jobs until there are
none left:

    for _worker in prange(jobs[WORKERS]):
        job = take(jobs)
        while job < count:
            ...
            job = take(jobs)

A job's result must not depend on who does it; then the bits do not depend on the threads.
"""
# ruff: noqa: ANN401, ARG001 - Numba's objects have no types, and it fixes the arguments.

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import get_num_threads
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

#: What is where in a kernel's `jobs`: the number of the next one, and of workers.
NEXT, WORKERS = 0, 1


def new_jobs() -> NDArray[np.int64]:
    """Returns `jobs` for one call of a kernel on as many threads as Numba is set to."""
    return np.array([0, get_num_threads()], np.int64)


def _take(typing: Any, jobs: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        counter = builder.gep(data, [ir.IntType(64)(NEXT)])
        return builder.atomic_rmw("add", counter, ir.IntType(64)(1), "monotonic")

    return types.int64(jobs), generate


#: Returns the number of the next job, counted from 0 on over all threads.
take: Callable[[NDArray[np.int64]], int] = intrinsic(_take)
