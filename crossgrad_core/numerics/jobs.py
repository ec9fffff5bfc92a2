"""Distribute jobs over threads dynamically: each thread takes the next job when it is idle.

A kernel takes jobs until no job is left:

    job = next_job(jobs, count)
    while job < count:
        ...
        job = next_job(jobs, count)

`parallel` calls the kernel on all threads at the same time. Numba's own `prange` divides the work
into equal parts in advance, and waits for all threads. If another program uses a core, this wait
can take longer than the computation with one thread. In this module, a helper thread that starts
too late is not waited for, and idle threads sleep.

Each thread begins with its own range of jobs, and then continues with jobs from the ranges of other
threads. A thread therefore often reads data that the same thread wrote in the previous kernel. Data
from the previous kernel are still in the cache of the thread's core. The result of a job must not
depend on the thread that executes the job. With this property, no bit of the results depends on the
number of threads.
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


#: Add 1 to a shared counter atomically, and return the previous value.
_next = cast("Callable[[Jobs, int], int]", intrinsic(_add))


@device
def next_job(jobs: Jobs, count: int) -> int:
    """Return the number of a free job, or `count` if no job is left.

    Only kernels may call this function.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        count: Number of jobs, which must be equal in all calls of a kernel.
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
    """Return an array of counters for each thread.

    The array contains the number of threads, and how many jobs were taken from each thread's range.

    All arrays share one memory block. A thread derives its own number from the length of its array.
    """
    room = np.zeros(2 * threads, np.int64)
    room[0] = threads
    return [room[: 1 + threads + thread] for thread in range(threads)]


def parallel(
    kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Run a kernel on as many threads as Numba uses. Return when all jobs are done."""
    Begun(kernel, *args, **kwargs).end()


class Begun:
    """A kernel that runs on other threads while the calling thread continues with other work.

    No other code may use the kernel's data until `end` returns. If only one thread is available,
    the kernel runs to its end immediately.

    Args:
        kernel: The kernel, as for `parallel`. The arguments of the kernel follow.
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
        """Execute the remaining jobs on this thread, too. Return when all jobs are done.

        After `end`, the object holds no references, and further calls have no effect.
        """
        if self._own is None:
            return
        try:
            self._own()
        finally:
            # Wait for all threads even after an error. No thread may use the arrays after this
            # method returns.
            self.leave()
        for call in self._calls:
            if call.error is not None:
                raise call.error
        self._own, self._calls = None, []

    def leave(self) -> None:
        """Return when no helper thread works on the kernel any more, even if jobs are left."""
        for call in self._calls:
            call.end()


class _Call:
    """A call for a helper thread.

    The call is skipped if its result is no longer needed when a thread starts the call.

    A plain lock is used, because a `Future` creates condition variables for each call and each
    wait.

    Args:
        call: The function that the helper thread calls.

    Attributes:
        error: The exception that the function raised; None without an exception.
    """

    def __init__(self, call: Callable[[], None]) -> None:
        self.error: BaseException | None = None
        self._call = call
        self._needed = True
        self._under_way = threading.Lock()

    def make(self) -> None:
        """Execute the call. A helper thread calls this method."""
        with self._under_way:
            if not self._needed:
                return
            try:
                self._call()
            except BaseException as error:
                self.error = error

    def end(self) -> None:
        """Wait until the call has finished; if the call has not begun, cancel it.

        Further calls of `end` have no effect.
        """
        self._needed = False
        with self._under_way:
            pass


class _Helpers:
    """The helper threads of a process. Helper threads use other cores than the calling thread.

    When a thread wakes another thread, Linux first starts the woken thread on the core of the
    waking thread. Linux moves the woken thread to an idle core later. The move to an idle core
    takes longer than most kernels.
    """

    def __init__(self) -> None:
        self._threads: list[int] = []
        self._core: int | None = None
        # Each thread has its own queue, so that a core repeatedly processes the same part of the
        # data.
        self._helpers: list[tuple[SimpleQueue[_Call | None], threading.Thread]] = []
        # If a helper thread were inside a library at interpreter exit, the process would abort.
        atexit.register(self._dismiss)

    def ask(self, calls: Sequence[_Call]) -> None:
        """Give each call to a different helper thread."""
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
        """Execute calls from the queue until the queue returns None."""
        self._threads.append(threading.get_native_id())
        keep_off(self._core, self._threads[-1:])
        while (call := queue.get()) is not None:
            call.make()
            del call  # Release the arrays of this call before the next call arrives.

    def _dismiss(self) -> None:
        """Stop all helper threads."""
        for queue, thread in self._helpers:
            queue.put(None)
            thread.join()
        self._helpers = []


@cache
def _helpers(process: int) -> _Helpers:
    """Return the helper threads of a process.

    A forked process starts new threads, because threads of the parent process do not exist in the
    fork.
    """
    return _Helpers()


def serial(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Run a kernel on this thread only, for small amounts of work.

    The result is bit-identical to the result of `parallel`.
    """
    (jobs,) = _jobs(1)
    kernel(jobs, *args, **kwargs)
