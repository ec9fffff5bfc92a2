"""The engine for a Ray cluster: each run is one task.

If a machine is lost, its tasks are repeated. The option `address` gives the address of the cluster
(default: RAY_ADDRESS, or else this machine).
"""

import logging
import signal
import socket
from collections import deque
from collections.abc import Iterator
from types import ModuleType
from typing import Any, Final

from crossgrad_core.commands import UserError, signal_names
from crossgrad_plugins.sweep.attempt import Outcome, Retries, Worker, carried_out
from crossgrad_plugins.sweep.engines import Work
from crossgrad_plugins.sweep.job import Job

OPTIONS: Final = ("address",)
#: Maximum number of seconds of one wait for ended tasks.
_PAUSE = 0.25
#: Number of seconds within which a cluster must answer.
_PATIENCE = 10.0


def carry_out(work: Work) -> Iterator[None]:
    """Execute runs as tasks; Ray repeats the tasks of a lost machine."""
    ray = _connected(work)
    try:
        crew = _WorkerPool(work, ray)
        while crew.is_busy():
            crew.look()
            yield
    finally:
        ray.shutdown()


class _WorkerPool:
    """The tasks of a sweep.

    Args:
        work: The arguments for the engine.
        ray: The imported library, connected to the cluster.
    """

    def __init__(self, work: Work, ray: ModuleType) -> None:
        self._work, self._ray = work, ray
        self._waiting = deque(work.jobs)
        self._tries = Retries(work.out)
        self._under_way: dict[Any, Job] = {}
        self._asked = 0
        needs: dict[str, Any] = {"num_cpus": work.threads, "max_retries": -1}
        if (memory := work.worker("").memory) is not None:
            needs["memory"] = memory
        self._task = ray.remote(scheduling_strategy="SPREAD", **needs)(_carried_out)

    def is_busy(self) -> bool:
        """Return True if runs are active or waiting."""
        return bool(self._under_way) or bool(self._waiting and not self._work.stop.count)

    def look(self) -> None:
        """Submit runs, and process the results of ended runs."""
        work, most = self._work, self._work.workers
        while self._waiting and not work.stop.count and len(self._under_way) < (most or 10**6):
            job = self._waiting.popleft()
            self._under_way[self._task.remote(job, work.worker("ray"))] = job
        if self._asked < work.stop.count:
            self._asked = work.stop.count
            for task in self._under_way:
                self._ray.cancel(task, force=False)
        done, _ = self._ray.wait(list(self._under_way), timeout=_PAUSE)
        for task in done:
            job = self._under_way.pop(task)
            if self._tries.once_more(job, self._outcome(task)):
                self._waiting.appendleft(job)

    def _outcome(self, task: object) -> Outcome:
        try:
            outcome: Outcome = self._ray.get(task)
        except self._ray.exceptions.TaskCancelledError:
            return Outcome("stopped")
        except self._ray.exceptions.RayError as error:
            return Outcome("died", str(error))
        return outcome


def _carried_out(job: Job, worker: Worker) -> Outcome:
    """Execute a run as a task; the worker's name contains its machine and process."""
    import os

    import ray

    node = ray.get_runtime_context().get_node_id()
    return carried_out(job, worker, f"ray-{node[:8]}-{os.getpid()}")


def _connected(work: Work) -> ModuleType:
    try:
        import ray
    except ImportError as error:
        raise UserError(
            "Ray is not installed",
            where="--engine ray",
            found=str(error),
            todo="pip install 'crossgrad[ray]'",
        ) from error
    address = work.options.get("address")
    handlers = {number: signal.getsignal(number) for number in signal_names()}
    try:
        _ping(address)
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(
            "the Ray cluster does not respond",
            where="--engine-option address",
            found=" ".join(str(error).split()),
            todo="start it with `ray start --head`, and give the address that it prints",
        ) from error
    # Restore the signal handlers, because Ray installs other handlers.
    for number, handler in handlers.items():
        signal.signal(number, handler)
    module: ModuleType = ray
    return module


def _ping(address: str | None) -> None:
    """Raise an OSError within seconds if the cluster does not answer.

    Ray itself would wait for minutes.
    """
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
