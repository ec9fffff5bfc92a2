"""Jobs that threads share: each takes the next one when it is done.

A kernel takes jobs until there are none left,

    job = take(jobs, count)
    while job < count:
        ...
        job = take(jobs, count)

and `share` calls it on all threads at once. Numba's own `prange` divides the work into equal runs
beforehand and waits for every thread; with a busy or a slow core that takes longer than one thread
alone. Here a helper that did not get to run in time is simply not needed any more, and threads that
have nothing to do sleep.

A thread begins with a run of jobs of its own and goes on with those that others have left: what it
wrote in one kernel, which its core still has at hand, it reads in the next one.

What a job computes must not depend on who does it; then no bit depends on the threads.
"""
# ruff: noqa: ANN401, ARG001 - Numba's objects have no types, and it fixes the arguments.

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


#: Adds 1 to a number that threads share; returns what it was.
_next = cast("Callable[[Jobs, int], int]", intrinsic(_add))


@device
def next_job(jobs: Jobs, count: int) -> int:
    """Returns the number of a job that nobody has taken, or `count`; only in kernels.

    Args:
        jobs: From `share`.
        count: Number of jobs, the same whenever a kernel asks.
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
    """For each thread the number of threads and of the jobs taken of each one's run.

    They lie in the same memory; a thread knows its own number from the length of what it has.
    """
    room = np.zeros(2 * threads, np.int64)
    room[0] = threads
    return [room[: 1 + threads + each] for each in range(threads)]


def parallel(
    kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Calls a kernel on as many threads as Numba is set to; returns when all jobs are done."""
    Begun(kernel, *args, **kwargs).end()


class Begun:
    """A kernel that the other threads have begun with, while this one does something else.

    Nobody may touch what the kernel reads or writes until `end`. One thread alone does all of it at
    once.

    Args:
        kernel: As for `share`, like its arguments.
    """

    def __init__(
        self, kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs
    ) -> None:
        own, *others = _jobs(numba.get_num_threads())
        self._own: Callable[[], None] | None = partial(kernel, own, *args, **kwargs)
        self._calls = [_Call(partial(kernel, jobs, *args, **kwargs)) for jobs in others]
        if self._calls:
            _helpers(os.getpid()).ask(self._calls)
        else:
            self.end()

    def end(self) -> None:
        """Does what is left, on this thread, too; returns when all jobs are done.

        It holds nothing any more then, and can be ended again.
        """
        if self._own is None:
            return
        try:
            self._own()
        finally:
            # Whatever happens, nobody works on the arrays any more when this returns.
            self.leave()
        for call in self._calls:
            if call.error is not None:
                raise call.error
        self._own, self._calls = None, []

    def leave(self) -> None:
        """Returns when nobody works on it any more, whether or not all jobs are done."""
        for call in self._calls:
            call.end()


class _Call:
    """A call that a helper makes, unless it is not needed any more by then.

    A bare lock: a `Future` makes conditions anew for each call and for each wait.

    Args:
        call: What to call.

    Attributes:
        error: What the call raised.
    """

    def __init__(self, call: Callable[[], None]) -> None:
        self.error: BaseException | None = None
        self._call = call
        self._needed = True
        self._under_way = threading.Lock()

    def make(self) -> None:
        """Makes the call; by the helper."""
        with self._under_way:
            if not self._needed:
                return
            try:
                self._call()
            except BaseException as error:
                self.error = error

    def end(self) -> None:
        """Returns when the call has been made, or never will be; may be repeated."""
        self._needed = False
        with self._under_way:
            pass


class _Helpers:
    """The helpers of a process, which run on other cores than the thread that asks them.

    Linux leaves a thread that is woken on the core of the one that woke it until it looks for cores
    with nothing to do, which takes longer than most kernels.
    """

    def __init__(self) -> None:
        self._threads: list[int] = []
        self._core: int | None = None
        # One for each thread: the same jobs are to go to the same core.
        self._helpers: list[tuple[SimpleQueue[_Call | None], threading.Thread]] = []
        # A thread that is in a library while the interpreter ends would end the process.
        atexit.register(self._dismiss)

    def ask(self, calls: Sequence[_Call]) -> None:
        """Asks as many helpers to make a call each."""
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
        """Makes calls until there is none."""
        self._threads.append(threading.get_native_id())
        keep_off(self._core, self._threads[-1:])
        while (call := queue.get()) is not None:
            call.make()
            del call  # Its arrays are not kept until the next one comes.

    def _dismiss(self) -> None:
        """Ends the helpers."""
        for queue, thread in self._helpers:
            queue.put(None)
            thread.join()
        self._helpers = []


@cache
def _helpers(process: int) -> _Helpers:
    """The helpers of a process; one that was forked off has none of its parent's threads."""
    return _Helpers()


def serial(kernel: Callable[Concatenate[Jobs, P], None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Calls a kernel on this thread only, for work too small to wake others for; the same bits."""
    (jobs,) = _jobs(1)
    kernel(jobs, *args, **kwargs)
