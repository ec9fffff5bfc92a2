"""Runs on the machines of a cluster: a task from its start to its end."""

from dataclasses import replace
from time import sleep

from crossgrad_plugins.sweep.attempt import PAUSE, Attempt, Outcome, Worker, is_free
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.layout import Layout
from crossgrad_plugins.sweep.run_status import is_finished

#: Seconds between two looks at a folder that another process writes into.
_WAIT = 1.0


def carried_out(job: Job, worker: Worker, name: str) -> Outcome:
    """Carries out a run and waits for its end; an interrupt stops it with a checkpoint.

    A task that is repeated because its machine was lost finds what the first one left.

    Args:
        job: The run.
        worker: Who carries it out.
        name: His name.
    """
    worker = replace(worker, name=name)
    while not is_free(job, worker):
        sleep(_WAIT)
    if is_finished(Layout(worker.out).run(job.id)):
        return Outcome("finished")
    attempt = Attempt(job, worker)
    while True:
        try:
            if (outcome := attempt.poll()) is not None:
                return outcome
            sleep(PAUSE)
        except KeyboardInterrupt:
            attempt.stop()
