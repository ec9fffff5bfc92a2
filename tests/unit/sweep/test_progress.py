"""What a sweep shows: a live table on a terminal, lines elsewhere, and a table at the end."""

import json
import sys
from types import SimpleNamespace

import pytest

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep import progress as screens
from crossgrad_plugins.sweep.grid import Metric
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.progress import Screen, Watch, duration, estimated
from crossgrad_plugins.sweep.run_status import Standing, append, read_records
from crossgrad_plugins.sweep.summary import earlier_rows, table, write_plan

JOBS = [Job(f"id{n}", "arm", "city", n, {}) for n in range(4)]


@pytest.fixture
def sweep(tmp_path):
    layout = Layout(tmp_path)
    layout.make()
    states = ("finished", "waiting", "waiting", "waiting")
    watch = Watch(layout, [Standing(j, s) for j, s in zip(JOBS, states, strict=True)])

    def tell(event, run, worker="1", **more):
        append(layout.records, {"event": event, "run": run, "worker": worker, **more})

    return SimpleNamespace(layout=layout, watch=watch, tell=tell)


def ended(sweep, run, status, **more):
    sweep.tell("begun", run)
    sweep.tell("ended", run, status=status, seconds=90.0, **more)


def test_a_line_reports_each_finished_or_failed_run(sweep, capsys):
    shown = Screen(sweep.watch, 2)
    ended(sweep, "id1", "finished")
    ended(sweep, "id2", "failed", error="the loss\nis not finite")
    shown.close()
    assert capsys.readouterr().err.splitlines() == [
        "... 2 of 4  city, arm, seed 1: finished after 90 s",
        "... 2 of 4  city, arm, seed 2: failed after 90 s: the loss is not finite",
    ]
    shown.close()
    assert not capsys.readouterr().err


def test_a_terminal_shows_one_table_that_is_redrawn(sweep, capsys, monkeypatch):
    monkeypatch.setattr(screens, "is_live", lambda stream: stream is sys.stderr)
    shown = Screen(sweep.watch, 2)
    ended(sweep, "id1", "failed", error="lost")
    sweep.tell("begun", "id2", "2")
    folder = sweep.layout.run("id2")
    folder.mkdir()
    (folder / "metrics.csv").write_text("step,psnr\n10,12.5\n20,13.25123456\n30,1")
    shown.show(at_once=True)
    first = capsys.readouterr().err
    assert "1 of 4 finished, 1 failed, 2 left" in first
    assert "city, arm, seed 2" in first and "step 20  psnr 13.2512" in first
    assert "failed: 1 of 4  city, arm, seed 1: failed after 90 s: lost" in first
    shown.show(at_once=True)
    assert capsys.readouterr().err.startswith("\x1b[3F\x1b[K")
    shown.show()
    assert not capsys.readouterr().err


def test_run_times_are_estimated_from_similar_runs(sweep):
    jobs = [
        Job("a", "arm", "city", 1, {}),
        Job("b", "arm", "city", 2, {}),
        Job("c", "other", "city", 1, {}),
        Job("d", "arm", "beach", 1, {}),
        Job("e", "arm", "beach", 1, {}, seconds=60.0),
    ]
    of = {job.id: job for job in jobs}
    for run, seconds in (("a", 10.0), ("a", 30.0), ("c", 50.0)):
        sweep.tell("ended", run, status="finished", seconds=seconds)
    sweep.tell("ended", "b", status="failed", seconds=1.0)
    records = read_records(sweep.layout.records)
    found = [estimated([job], of, records) for job in jobs]
    assert [each.seconds for each in found] == [20.0, 20.0, 50.0, 0.0, 72.0]
    assert [each.unknown for each in found] == [0, 0, 0, 1, 0]
    total = estimated(jobs, of, records)
    assert total.text(2) == "about 81 s; the time of 1 run is not known yet"


def test_the_estimate_of_a_sweep_is_at_least_its_longest_run(sweep):
    jobs = [Job(name, "arm", "city", n, {}, seconds=600.0) for n, name in enumerate("abc")]
    found = estimated(jobs, {job.id: job for job in jobs}, [])
    assert [found.text(workers) for workers in (1, 2, 16)] == [
        "about 31 min",
        "about 15 min",
        "about 10 min",
    ]


def test_durations_are_rounded_for_people():
    given = (3, 119.4, 120, 7199, 9000)
    assert list(map(duration, given)) == ["3 s", "119 s", "2 min", "120 min", "2.5 h"]


def test_the_table_shows_means_over_seeds_and_marks_the_best_arm():
    values = {"id0": 10.0, "id1": 12.0, "id2": 13.0, "id3": None}
    jobs = [Job(f"id{n}", "ab"[n // 2], "city", n % 2, {}) for n in range(4)]
    found = [
        Standing(job, "finished", summary={"overall": {"psnr": values[job.id]}}) for job in jobs
    ]
    assert list(table(jobs, found, Metric())) == [
        "psnr, mean over seeds  city",
        "a                      11.000 ± 1.414 (2)",
        "b                      13.000 (1) *",
    ]
    assert list(table(jobs, found, Metric(goal="minimize")))[1].endswith("*")


def test_a_metric_that_no_run_has_is_reported_with_the_available_metrics():
    jobs, overall = JOBS[:2], {"psnr": 20.0, "lpips": None, "ssim": 0.5}
    found = [Standing(job, "finished", summary={"overall": overall}) for job in jobs]
    told = list(table(jobs, found, Metric(name="psnr_street")))[-1]
    assert told.startswith("no finished run has psnr_street; the runs have psnr, ssim")
    waiting = [Standing(job, "waiting") for job in jobs]
    assert "no finished run" not in "".join(table(jobs, waiting, Metric(name="psnr_street")))


def test_the_plan_keeps_earlier_runs_of_the_folder(tmp_path):
    layout = Layout(tmp_path)
    layout.make()
    write_plan(layout, JOBS[:2])
    layout.run("id0").mkdir()
    write_plan(layout, [Job("id2", "arm, k=1", "city", 2, {})])
    assert layout.plan.read_text().splitlines() == [
        "run,scene,configuration,seed",
        'id2,city,"arm, k=1",2',
        "id0,city,arm,0",
    ]


def test_a_foreign_table_with_the_name_of_the_plan_is_not_overwritten(tmp_path):
    layout = Layout(tmp_path)
    layout.plan.write_text("arm,scene\nmine,city\n")
    with pytest.raises(UserError, match="not written by a sweep"):
        write_plan(layout, JOBS[:2])
    assert layout.plan.read_text() == "arm,scene\nmine,city\n"


def test_rows_of_earlier_grids_are_distinguished_from_rows_of_the_newest_grid(tmp_path):
    layout = Layout(tmp_path)
    assert earlier_rows(layout) == frozenset()
    layout.make()
    layout.run("id0").mkdir()
    layout.run("id1").mkdir()
    was = [Job("id0", "a", "city", 1, {}), Job("id1", "b", "city", 1, {})]
    write_plan(layout, was)
    assert earlier_rows(layout) == frozenset()
    # Another configuration is a now; that of b is called c, and no longer b.
    now = [Job("id2", "a", "city", 1, {}), Job("id1", "c", "city", 1, {})]
    write_plan(layout, now)
    assert earlier_rows(layout) == {("id0", "a")}
    assert ",b," not in layout.plan.read_text()
    write_plan(layout, was)
    assert earlier_rows(layout) == frozenset()
    assert ",c," not in layout.plan.read_text()


def test_a_record_from_a_machine_with_a_slow_clock_is_read(sweep, monkeypatch):
    ended(sweep, "id1", "finished")
    assert len(sweep.watch.look()) == 1
    (line,) = [each for each in read_records(sweep.layout.records) if each.event == "ended"]
    path = sweep.layout.records / "far.jsonl"
    late = {"event": "ended", "run": "id2", "worker": "far", "status": "finished", "host": "far"}
    path.write_text(json.dumps({**late, "time": line.time.replace("20", "19", 1)}) + "\n")
    assert [each.run for each in sweep.watch.look()] == ["id2"]
    assert sweep.watch.finished == 3
