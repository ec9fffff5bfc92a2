"""Slurm through submitit: the script, and runs by its local executor."""

import sys

import pytest
from support import fake_run

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.engines import Work, engine
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.run_status import read_records, standings

pytest.importorskip("submitit")


def made(folder, acts, options, **more):
    layout = Layout(folder / "out")
    layout.make()
    jobs = [Job(f"{act}-{n}", act, "scene", n, {"do": act}) for n, act in enumerate(acts)]
    command = (sys.executable, fake_run.__file__)
    return Work(jobs, layout.out, folder, 2, options=options, command=command, **more)


def states(work):
    layout = Layout(work.out)
    found = standings(work.jobs, layout, read_records(layout.records), alive=False)
    return [each.state for each in found]


@pytest.mark.slow
def test_the_local_executor_executes_all_runs_and_a_dead_run_again(tmp_path):
    work = made(tmp_path, ["finish", "fail", "die_once"], {"cluster": "local"}, workers=3)
    for _ in engine("slurm")(work):
        pass
    assert states(work) == ["finished", "failed", "finished"]
    workers = {each.worker for each in read_records(work.out / "workers")}
    assert all(name.startswith("slurm-") for name in workers)
    assert len(workers) == 4  # A job for each attempt.


def test_a_stop_request_stops_the_slurm_jobs(tmp_path):
    work = made(tmp_path, ["hang", "finish"], {"cluster": "local"})
    for _ in engine("slurm")(work):
        if (work.out / "runs" / "hang-0" / "ready").exists():
            work.stop.count = 1
    assert states(work) == ["interrupted", "waiting"]


def test_the_script_contains_the_requested_slurm_options(tmp_path):
    from crossgrad_plugins.sweep.engines.slurm import script

    options = {"partition": "gpu", "time": "90"}
    text = script(made(tmp_path, ["finish"] * 5, options, workers=3, memory=4.0))
    for line in (
        "#SBATCH --job-name=crossgrad",
        "#SBATCH --array=0-4%3",
        "#SBATCH --cpus-per-task=2",
        "#SBATCH --mem=4GB",
        "#SBATCH --partition=gpu",
        "#SBATCH --time=90",
    ):
        assert line in text.splitlines()
    assert "srun" in text and "submitit.core._submit" in text


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"cluster": "slurm"}, "srun"),
        ({"cluster": "local", "time": "1h"}, "1h"),
    ],
)
def test_a_missing_slurm_program_or_setting_is_refused(tmp_path, monkeypatch, options, found):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=found):
        next(engine("slurm")(made(tmp_path, ["finish"], options)))
