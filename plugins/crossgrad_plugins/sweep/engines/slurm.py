"""The engine for a Slurm cluster, through submitit: each run is one job.

Options: `cluster` (slurm, or local for a test on this machine), `time` in minutes (1440), and the
sbatch options `partition`, `account`, `qos`, `constraint`, `exclude`, `nodelist`, `gres`,
`comment`.
"""

from collections import deque
from collections.abc import Iterator
from time import sleep
from types import ModuleType
from typing import Any, Final

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.attempt import Outcome, Retries, Worker, carried_out
from crossgrad_plugins.sweep.engines import Work
from crossgrad_plugins.sweep.job import Job

#: Options that are passed to sbatch unchanged.
SBATCH: Final = (
    *("partition", "account", "qos", "constraint", "exclude", "nodelist", "gres", "comment"),
)
OPTIONS: Final = ("cluster", "time", *SBATCH)
_NAME: Final = "crossgrad"
#: Default time limit of a job, minutes.
_TIME: Final = 1440
#: Seconds between two checks of the jobs.
_PAUSE: Final = 0.5
#: Default number of jobs of an array that run at the same time.
_MOST: Final = 256


def carry_out(work: Work) -> Iterator[None]:
    """Execute runs as jobs; after preemption, a job continues when Slurm starts it again."""
    crew = _WorkerPool(work)
    while crew.is_busy():
        crew.look()
        yield
        sleep(_PAUSE)


def script(work: Work) -> str:
    """Return the sbatch script that runs the whole sweep."""
    _submitit()
    from submitit.slurm.slurm import _convert_mem, _make_sbatch_string

    parameters: dict[str, Any] = {
        "job_name": _NAME,
        "time": _minutes(work),
        "cpus_per_task": work.threads,
    }
    if work.memory is not None:
        parameters["mem"] = _convert_mem(work.memory)
    parameters |= {name: work.options[name] for name in SBATCH if name in work.options}
    command = "python -u -m submitit.core._submit " + str(work.out / "slurm")
    text: str = _make_sbatch_string(
        command,
        folder=work.out / "slurm" / "%j",
        map_count=max(1, len(work.jobs)),
        array_parallelism=work.workers or _MOST,
        **parameters,
    )
    return text


class Task:
    """A run as a Slurm job; submitit submits the job again after preemption.

    Args:
        job: The run.
        worker: The worker that executes the run.
    """

    def __init__(self, job: Job, worker: Worker) -> None:
        self.job, self.worker = job, worker

    def __call__(self) -> Outcome:
        """Execute the run."""
        import submitit

        return carried_out(self.job, self.worker, f"slurm-{submitit.JobEnvironment().job_id}")

    def checkpoint(self) -> object:
        """Return the job that continues from the checkpoint of the run after preemption."""
        import submitit

        return submitit.helpers.DelayedSubmission(self)


class _WorkerPool:
    """The jobs of a sweep.

    Args:
        work: The arguments for the engine.
    """

    def __init__(self, work: Work) -> None:
        self._work = work
        self._submitit = _submitit()
        self._executor = _executor(work, self._submitit)
        # Only Slurm has a queue. submitit starts all jobs of other clusters at once, so the number
        # of submitted jobs is limited here.
        queued = self._executor.cluster == "slurm"
        self._most = len(work.jobs) if queued else work.workers or 1
        self._waiting = deque(work.jobs)
        self._tries = Retries(work.out)
        self._under_way: list[tuple[Any, Job]] = []
        self._asked = 0

    def is_busy(self) -> bool:
        """Return True if runs are active or waiting."""
        return bool(self._under_way) or bool(self._waiting and not self._work.stop.count)

    def look(self) -> None:
        """Submit runs, and process the results of ended runs."""
        stop = self._work.stop
        if self._waiting and not stop.count:
            self._hand_in()
        if self._asked < stop.count:
            self._asked = stop.count
            for handed, _ in self._under_way:
                handed.cancel(check=False)
        for handed, job in [entry for entry in self._under_way if entry[0].done()]:
            self._under_way.remove((handed, job))
            if self._tries.once_more(job, self._outcome(handed)) and not stop.count:
                self._waiting.appendleft(job)

    def _hand_in(self) -> None:
        room = self._most - len(self._under_way)
        jobs = [self._waiting.popleft() for _ in range(min(room, len(self._waiting)))]
        if jobs:
            tasks = [Task(job, self._work.worker("slurm")) for job in jobs]
            with self._executor.batch():
                handed = [self._executor.submit(task) for task in tasks]
            self._under_way += zip(handed, jobs, strict=True)

    def _outcome(self, handed: Any) -> Outcome:  # noqa: ANN401 - a job of submitit
        if self._asked:
            return Outcome("stopped")
        try:
            outcome: Outcome = handed.result()
        except self._submitit.core.utils.UncompletedJobError as error:
            return Outcome("died", str(error).splitlines()[0])
        except self._submitit.core.utils.FailedJobError as error:
            return Outcome("died", str(error).splitlines()[-1])
        return outcome


def _executor(work: Work, submitit: ModuleType) -> Any:  # noqa: ANN401 - an executor of submitit
    cluster = work.options.get("cluster", "slurm")
    try:
        executor = submitit.AutoExecutor(folder=work.out / "slurm" / "%j", cluster=cluster)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            "no Slurm cluster is available on this machine",
            where="--engine slurm",
            found=" ".join(str(error).split()),
            todo="start the sweep on a machine with sbatch and srun, or test it with "
            "--engine-option cluster=local",
        ) from error
    sbatch = {f"slurm_{name}": work.options[name] for name in SBATCH if name in work.options}
    executor.update_parameters(
        **_general(work), **sbatch, slurm_array_parallelism=work.workers or _MOST
    )
    return executor


def _general(work: Work) -> dict[str, Any]:
    """Return the parameters that all executors of submitit accept."""
    parameters: dict[str, Any] = {
        "name": _NAME,
        "timeout_min": _minutes(work),
        "cpus_per_task": work.threads,
    }
    return parameters if work.memory is None else {**parameters, "mem_gb": work.memory}


def _minutes(work: Work) -> int:
    text = work.options.get("time", str(_TIME))
    if text.isdecimal() and int(text):
        return int(text)
    raise UserError(
        "the time limit of a job is not a whole number of minutes",
        where="--engine-option time",
        expected="a whole number above 0",
        found=text,
        todo="write for example --engine-option time=120",
    )


def _submitit() -> ModuleType:
    """Import the library submitit."""
    try:
        import submitit
    except ImportError as error:
        raise UserError(
            "submitit is not installed",
            where="--engine slurm",
            found=str(error),
            todo="pip install 'crossgrad[slurm]'",
        ) from error
    module: ModuleType = submitit
    return module
