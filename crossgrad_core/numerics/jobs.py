"""Dynamic distribution of jobs over threads: each thread takes the next job when it is idle.

A kernel takes jobs until none is left:

    job = next_job(jobs, count)
    while job < count:
        ...
        job = next_job(jobs, count)

`parallel` calls the kernel on all threads at once. Numba's own `prange` divides the work into equal
parts in advance and waits for every thread. If a core is busy or slow, waiting takes longer than
computing with one thread. Here, a helper thread that starts too late is skipped, and idle threads
sleep.

A thread starts with its own range of jobs and continues with the remaining jobs of other threads.
Therefore, a thread reads the data that it wrote in the previous kernel, and the cache of its core
still contains this data. The result of a job must not depend on the thread that runs the job. Then
the number of threads does not change any bit of the results.
"""
# ruff: noqa: ANN401, ARG001 - Numba's objects have no types, and Numba defines the arguments.

import atexit
import os
import threading
from collections.abc import Callable, Sequence
from functools import cache, partial
from queue import SimpleQueue
from typing import Any, Concatenate, ParamSpec, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device
from crossgrad_core.system.cores import current_core, keep_off

P = ParamSpec("P")
Jobs = NDArray[np.int64]


def _add(typing: Any, jobs: Any, place: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first = context.make_array(signature.args[0])(context, builder, args[0]).data
        counter = builder.gep(first, [args[1]])
        return builder.atomic_rmw("add", counter, ir.IntType(64)(1), "monotonic")

    return types.int64(jobs, types.intp), generate


#: Add 1 to a shared number atomically, and return the former value.
_next = cast("Callable[[Jobs, int], int]", intrinsic(_add))


@device
def next_job(jobs: Jobs, count: int) -> int:
    """Return the number of a free job, or `count` if no job is left; only for use in kernels.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        count: Number of jobs, the same in every call of a kernel.
    """
    threads = jobs[0]
    mine = jobs.shape[0] - 1 - threads
    for k in range(threads):
        owner = (mine + k) % threads
        begin, end = owner * count // threads, (owner + 1) * count // threads
        if begin + jobs[1 + owner] < end:
            job: int = begin + _next(jobs, 1 + owner)
            if job < end:
                return job
    return count


def _jobs(threads: int) -> list[Jobs]:
    """Return for each thread: the number of threads, and the jobs taken from each thread's range.

    The arrays share one memory block. A thread derives its own number from the length of its array.
    """
    room = np.zeros(2 * threads, np.int64)
    room[0] = threads
    return [room[: 1 + threads + thread] for thread in range(threads)]


def parallel(
    kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Run a kernel on Numba's number of threads; return when all jobs are done."""
    Begun(kernel, *args, **kwargs).end()


class Begun:
    """A kernel that runs on the other threads while the calling thread does other work.

    No other code may use the data of the kernel until `end` returns. With one thread, the kernel
    runs to its end immediately.

    Args:
        kernel: The kernel, as for `parallel`; its arguments follow.
    """

    def __init__(
        self, kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs
    ) -> None:
        own_jobs, *others = _jobs(numba.get_num_threads())
        self._own: Callable[[], None] | None = partial(kernel, own_jobs, *args, **kwargs)
        self._calls = [_Call(partial(kernel, jobs, *args, **kwargs)) for jobs in others]
        if self._calls:
            _helpers(os.getpid()).ask(self._calls)
        else:
            self.end()

    def end(self) -> None:
        """Do the remaining jobs on this thread as well, and return when all jobs are done.

        The object then holds no more references; further calls have no effect.
        """
        if self._own is None:
            return
        try:
            self._own()
        finally:
            # Wait for all threads even after an error, so that none uses the arrays after this
            # method returns.
            self.leave()
        for call in self._calls:
            if call.error is not None:
                raise call.error
        self._own, self._calls = None, []

    def leave(self) -> None:
        """Return when no helper works on the kernel any more, even if jobs are left."""
        for call in self._calls:
            call.end()


class _Call:
    """A call for a helper, skipped if it is no longer needed when the helper starts.

    The class uses a bare lock, because a `Future` creates conditions for each call and for each
    wait.

    Args:
        call: The function to call.

    Attributes:
        error: The exception of the call; None if there was none.
    """

    def __init__(self, call: Callable[[], None]) -> None:
        self.error: BaseException | None = None
        self._call = call
        self._needed = True
        self._under_way = threading.Lock()

    def make(self) -> None:
        """Execute the call; this function is called by a helper thread."""
        with self._under_way:
            if not self._needed:
                return
            try:
                self._call()
            except BaseException as error:
                self.error = error

    def end(self) -> None:
        """Return when the call has finished or is cancelled; `end` may be called repeatedly."""
        self._needed = False
        with self._under_way:
            pass


class _Helpers:
    """The helper threads of a process, on other cores than the calling thread.

    When a thread wakes another thread, Linux starts the woken thread on the same core and moves it
    to an idle core later. This takes longer than most kernels.
    """

    def __init__(self) -> None:
        self._threads: list[int] = []
        self._core: int | None = None
        # Each thread has its own queue, so that equal jobs go to the same core.
        self._helpers: list[tuple[SimpleQueue[_Call | None], threading.Thread]] = []
        # A thread inside a library at interpreter exit would abort the process.
        atexit.register(self._dismiss)

    def ask(self, calls: Sequence[_Call]) -> None:
        """Give each call to a helper thread of its own."""
        core = current_core()
        if core != self._core:
            self._core = core
            keep_off(core, self._threads)
        while len(self._helpers) < len(calls):
            queue: SimpleQueue[_Call | None] = SimpleQueue()
            thread = threading.Thread(
                target=self._help, args=[queue], name="crossgrad-kernels", daemon=True
            )
            thread.start()
            self._helpers.append((queue, thread))
        for (queue, _), call in zip(self._helpers, calls, strict=False):
            queue.put(call)

    def _help(self, queue: "SimpleQueue[_Call | None]") -> None:
        """Make calls until the queue returns None."""
        self._threads.append(threading.get_native_id())
        keep_off(self._core, self._threads[-1:])
        while (call := queue.get()) is not None:
            call.make()
            del call  # Release the arrays of the call before the next call arrives.

    def _dismiss(self) -> None:
        """Stop the helper threads."""
        for queue, thread in self._helpers:
            queue.put(None)
            thread.join()
        self._helpers = []


@cache
def _helpers(process: int) -> _Helpers:
    """Return the helpers of a process; a forked process does not inherit its parent's threads."""
    return _Helpers()


def serial(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Run a kernel on this thread only, for little work; the result has the same bits."""
    (jobs,) = _jobs(1)
    kernel(jobs, *args, **kwargs)
