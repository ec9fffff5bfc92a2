"""Seconds of CPU beside those of the wall: what is counted, recorded and refused."""

import json
from types import SimpleNamespace

import pytest
import torch
from support.pace import each_step_takes
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.app import check_clock
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.results import machine
from crossgrad_core.run.results.config_file import read_config
from crossgrad_core.run.results.machine import WORTH_A_CALIBRATION, Machine, calibrated
from crossgrad_core.run.results.metrics_csv import read_metrics
from crossgrad_core.run.session import totals
from crossgrad_core.run.settings import parsed
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import state as states
from crossgrad_core.training.budget import Timed
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import Clock, PhaseTimer


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def test_cpu_time_is_counted_for_training_phases_only(monkeypatch):
    times = iter([10.0, 10.5, 12.0, 12.25])
    monkeypatch.setattr(states, "process_time", lambda: next(times))
    clock, laps = Clock(), PhaseTimer(cpu_border=next(times))
    laps.lap("photos")
    laps.leave_out(3.0, 1.25)  # Decoding: 1.25 of the 1.5 seconds until the next border.
    laps.lap("render")
    laps.lap("other")
    clock.count(laps)
    assert clock.cpu == clock.trained("cpu") == pytest.approx(1.0)
    assert clock.trained("wall") == clock.train


@pytest.mark.parametrize(("kind", "steps"), [("wall", 100), ("cpu", 400)])
def test_a_budget_ends_the_run_by_its_own_clock(kind, steps):
    length, state = Timed(10.0, kind), SimpleNamespace(step=0, rewinds=0, clock=Clock())
    looks = 0
    while state.clock.trained(kind) < 10.0 - 1e-9:
        state.step += 1
        state.clock.train += 0.1
        state.clock.cpu += 0.025
        if length.due(state):
            looks += 1
            length._look(state)
    assert state.step == steps and looks >= steps // 20


@pytest.mark.parametrize(
    ("settings", "threads", "why"),
    [
        ({"seconds": 1.0, "clock": "cpu"}, 2, "2 threads(.|\n)*--threads 1"),
        ({"seconds": 1.0, "clock": "cpu", "device": "cuda"}, 1, "the time of a GPU"),
    ],
)
def test_the_cpu_clock_is_refused_if_cpu_time_does_not_measure_work(
    settings, threads, why, monkeypatch
):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    with pytest.raises(UserError, match=why):
        check_clock(RunConfig(**settings))


@pytest.mark.parametrize(
    ("settings", "threads"),
    [
        ({"seconds": 1.0, "clock": "cpu"}, 1),
        ({"seconds": 1.0, "clock": "cpu", "device": "cpu:0"}, 1),
        ({"seconds": 1.0}, 2),
    ],
)
def test_other_budgets_accept_any_number_of_threads(settings, threads, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    check_clock(RunConfig(**settings))


def test_a_run_on_the_cpu_clock_is_recorded_and_repeated(scene, tmp_path, monkeypatch):
    each_step_takes(monkeypatch, 0.02)
    given = {"scene": str(scene), "threads": 1, "seconds": 0.5, "clock": "cpu"}
    assert app.run({**given, "out": str(tmp_path / "timed")}, verbosity=-1) == 0
    rows = read_metrics(tmp_path / "timed")
    seconds = [row["cpu_seconds"] for row in rows]
    assert seconds == sorted(seconds) and seconds[-1] == pytest.approx(0.5)
    summary = json.loads((tmp_path / "timed" / "summary.json").read_text())
    assert summary["cpu_seconds"] == pytest.approx(seconds[-1], abs=1e-3)
    assert "cpu" not in summary["seconds"]
    assert summary["peak_primitives"] >= max(row["primitives"] for row in rows)
    load_seen, calibration = (summary["environment"][name] for name in ("load", "calibration"))
    assert load_seen["max"] >= load_seen["mean"] >= 0 and calibration is None
    assert any("s of CPU time" in note for note in summary["notes"])
    stored = read_config(tmp_path / "timed")
    assert (stored["clock"], stored["seconds"]) == ("cpu", None)
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    states = [load(latest(tmp_path / name)).parameters for name in ("timed", "again")]
    assert all(torch.equal(tensor, states[1][name]) for name, tensor in states[0].items())


def test_the_peak_of_primitives_is_kept_after_pruning(scene, tmp_path):
    times = {"densify_from": 1, "densify_every": 4, "densify_until": 40}
    setup = assemble(parsed({"steps": 30, "views": 1, **times}), sample_scene(), "none")
    state = first_state(setup)
    counts = [timed_step(setup, state).primitives for _ in range(20)]
    assert max(counts) > counts[0]
    assert totals(setup, state).peak_primitives == max(counts)
    state.parameters = {name: tensor[:3] for name, tensor in state.parameters.items()}
    assert totals(setup, state).peak_primitives == max(counts)


def test_the_calibration_measures_the_speed_of_the_machine():
    known = calibrated(0.05)
    assert 0.05 <= known.seconds < 5.0
    assert known.cpu_rate >= 0.9 * known.rate > 0


def test_only_long_runs_are_calibrated_and_only_once(monkeypatch):
    calls = []
    monkeypatch.setattr(machine, "calibrated", lambda: calls.append(1) or calibrated(0.01))
    watch = Machine()
    assert watch.figures(WORTH_A_CALIBRATION / 2) == {"load": None, "calibration": None}
    figures = [watch.figures(WORTH_A_CALIBRATION) for _ in range(2)]
    assert figures[0] == figures[1] and len(calls) == 1
    assert figures[0]["calibration"].keys() == {"seconds", "rate", "cpu_rate"}


def test_the_machine_load_is_read_once_in_a_second(monkeypatch):
    now, loads = iter([5.0, 5.5, 6.5, 9.0]), iter([1.0, 3.0, 2.0])
    monkeypatch.setattr(machine, "perf_counter", lambda: next(now))
    monkeypatch.setattr(machine.os, "getloadavg", lambda: (next(loads), 0.0, 0.0))
    watch = Machine()
    for _ in range(4):
        watch.crossgrad_step_end(record=None)
    assert watch.figures(1.0)["load"] == {"mean": 2.0, "max": 3.0}
