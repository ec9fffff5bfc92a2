"""Runs on the cores of this machine: what ends them, and what becomes of them."""

import os
import sys
from pathlib import Path

import pytest
from support import fake_run

from crossgrad_plugins.sweep.engines import Stop, Work, engine
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.machine import Machine
from crossgrad_plugins.sweep.run_status import read_records, standings

GIB = 2**30


@pytest.fixture
def work(tmp_path):
    """Makes the work of runs that do what they are told; so many at a time."""

    def make(*acts, workers=2, memory=None):
        layout = Layout(tmp_path / "out")
        layout.make()
        jobs = [Job(f"{act}-{n}", act, "scene", n, {"do": act}) for n, act in enumerate(acts)]
        cores = ((min(os.sched_getaffinity(0)),),) * workers
        machine, command = Machine(cores, memory), (sys.executable, fake_run.__file__)
        return Work(jobs, layout.out, tmp_path, 1, machine=machine, command=command)

    return make


def carried_out(work):
    for _ in engine("local")(work):
        pass
    return {each.job.id: each for each in state(work)}


def state(work):
    layout = Layout(work.out)
    return standings(work.jobs, layout, read_records(layout.records), alive=False)


def starts(work, name):
    lines = (work.out / "runs" / name / "starts.txt").read_text().splitlines()
    return [line.split() for line in lines]


def test_all_runs_finish_once_with_their_cores_threads_and_folder(work):
    given = work(*["finish"] * 5)
    found = carried_out(given)
    assert [each.state for each in found.values()] == ["finished"] * 5
    core = str(min(os.sched_getaffinity(0)))
    for name in found:
        ((_, cores, threads, folder),) = starts(given, name)
        assert (cores, threads, folder) == (core, "1", str(given.folder))


def test_a_failed_run_stops_no_other_run_and_has_a_reason(work):
    given = work("fail", "refuse", "finish")
    found = carried_out(given)
    assert [each.state for each in found.values()] == ["failed", "failed", "finished"]
    assert found["fail-0"].error == "the loss is not finite"
    assert found["refuse-1"].error == "error: there is no such thing\n  where:    here"


def test_a_refused_run_has_the_reason_of_its_last_attempt(work):
    given = work("refuse")
    folder = given.out / "runs" / "refuse-0"
    folder.mkdir()
    (folder / "summary.json").write_text('{"status": "failed", "error": "long ago"}')
    assert carried_out(given)["refuse-0"].error.startswith("error: there is no such thing")


def test_a_run_whose_process_dies_is_tried_again(work):
    given = work("die_once", workers=1)
    assert carried_out(given)["die_once-0"].state == "finished"
    assert len(starts(given, "die_once-0")) == 2


def test_a_run_that_dies_repeatedly_without_progress_has_failed(work):
    given = work("die", "finish", workers=1)
    found = carried_out(given)
    assert (found["die-0"].state, found["finish-1"].state) == ("failed", "finished")
    assert len(starts(given, "die-0")) == 3
    assert "SIGKILL" in found["die-0"].error and "3 times" in found["die-0"].error


def test_a_run_that_makes_progress_between_deaths_continues(work):
    given = work("go_on", workers=1)
    assert carried_out(given)["go_on-0"].state == "finished"
    assert len(starts(given, "go_on-0")) == 5


def test_a_run_that_uses_too_much_memory_is_stopped(work):
    found = carried_out(work("eat", "finish", memory=GIB // 8))
    assert [each.state for each in found.values()] == ["failed", "finished"]
    assert "GiB" in found["eat-0"].error


def test_a_stop_request_stops_running_runs_and_starts_no_other_run(work):
    given = work("hang", "hang", "finish")
    for _ in engine("local")(given):
        if all((given.out / "runs" / f"hang-{n}" / "ready").exists() for n in (0, 1)):
            given.stop.count = 1
    assert [each.state for each in state(given)] == ["interrupted", "interrupted", "waiting"]
    ends = [each for each in read_records(given.out / "workers") if each.event == "ended"]
    assert [each.status for each in ends] == ["stopped", "stopped"]


def test_a_run_whose_folder_is_locked_waits(work):
    import fcntl

    given = work("finish", "finish", workers=1)
    folder = given.out / "runs" / "finish-0"
    folder.mkdir(parents=True)
    order = []
    with (folder / "run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for _ in engine("local")(given):
            order = [each.run for each in read_records(given.out / "workers")]
            if len(order) == 2:
                fcntl.flock(lock, fcntl.LOCK_UN)
    assert order[:2] == ["finish-1", "finish-1"]
    assert [each.state for each in state(given)] == ["finished", "finished"]


def test_each_sweep_work_has_a_separate_stop_request():
    one, other = (Work([], Path(), Path(), 1) for _ in range(2))
    one.stop.count += 1
    assert other.stop == Stop()
