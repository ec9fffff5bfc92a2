"""The engine that uses the cores of this machine."""

from collections import Counter, deque
from collections.abc import Iterator
from time import sleep
from typing import Final

from crossgrad_plugins.sweep.attempt import PAUSE, Attempt, Retries, Worker, is_free
from crossgrad_plugins.sweep.engines import Work
from crossgrad_plugins.sweep.job import Job

OPTIONS: Final = ()


def carry_out(work: Work) -> Iterator[None]:
    """Execute each run in a separate process on the cores of its worker."""
    crew = _WorkerPool(work)
    while crew.is_busy():
        crew.look()
        yield
        sleep(PAUSE)


class _WorkerPool:
    """The workers of this machine.

    Args:
        work: The arguments for the engine.
    """

    def __init__(self, work: Work) -> None:
        self._work = work
        self._waiting = deque(work.jobs)
        self._tries = Retries(work.out)
        self._free = list(reversed(_workers(work)))
        self._under_way: list[Attempt] = []
        self._asked = Counter[Attempt]()

    def is_busy(self) -> bool:
        """Return True if runs are active or waiting."""
        return bool(self._under_way) or bool(self._waiting and not self._work.stop.count)

    def look(self) -> None:
        """Process the results of ended runs, and start runs on free workers."""
        for attempt in list(self._under_way):
            while self._asked[attempt] < self._work.stop.count:
                self._asked[attempt] += 1
                attempt.stop()
            outcome = attempt.poll()
            if outcome is not None:
                self._under_way.remove(attempt)
                self._free.append(attempt.worker)
                if self._tries.once_more(attempt.job, outcome):
                    self._waiting.appendleft(attempt.job)
        if not self._work.stop.count:
            self._begin()

    def _begin(self) -> None:
        while self._free and (job := self._next()) is not None:
            self._waiting.remove(job)
            self._under_way.append(Attempt(job, self._free.pop()))

    def _next(self) -> Job | None:
        """Return the first waiting run whose folder no process of an earlier sweep uses."""
        worker = self._free[-1]
        return next((job for job in self._waiting if is_free(job, worker)), None)


def _workers(work: Work) -> list[Worker]:
    machine = work.machine
    if machine is None:
        raise ValueError("the work does not say how to divide this machine among runs")
    return [
        work.worker(str(number), cores, machine.memory)
        for number, cores in enumerate(machine.cores, 1)
    ]
