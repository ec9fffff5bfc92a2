"""The notes a run makes at its start are repeated when the run is resumed."""

import json

import pytest
from support.pace import each_step_takes
from support.scenes import write_tiny_scene

from crossgrad_core.run import app
from crossgrad_core.run.results.config_file import read_config, read_notes

GROWTH = "no density control: in "


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "eval_every": 1000, "threads": 1}
    assert app.run({**given, **settings}, verbosity=-1) == 0
    return notes(out)


def notes(out):
    return json.loads((out / "summary.json").read_text())["notes"]


def of(found, start):
    return [note for note in found if note.startswith(start)]


def test_a_resumed_run_repeats_the_notes_about_its_choices(scene, tmp_path):
    out = tmp_path / "run"
    before = run(scene, out, steps=6, stop_after=3, exposure={"name": "auto"})
    assert len(of(before, "exposure auto: none")) == len(of(before, GROWTH)) == 1
    assert app.run({}, resume=out, verbosity=-1) == 0
    assert notes(out) == before == list(read_notes(out))
    assert all(note in (out / "log.txt").read_text() for note in before)


def test_a_run_killed_before_its_first_checkpoint_repeats_its_notes(scene, tmp_path):
    before = run(scene, tmp_path / "run", steps=2, exposure={"name": "auto"})
    (tmp_path / "killed").mkdir()
    (tmp_path / "run" / "config.yaml").rename(tmp_path / "killed" / "config.yaml")
    assert app.run({}, resume=tmp_path / "killed", verbosity=-1) == 0
    assert notes(tmp_path / "killed")[1:] == before


def test_a_resumed_run_with_a_time_budget_keeps_its_planned_steps(scene, tmp_path, monkeypatch):
    out = tmp_path / "run"
    each_step_takes(monkeypatch, 0.05)
    run(scene, out, seconds=1.5, stop_after=14)
    assert app.run({}, resume=out, verbosity=-1) == 0
    (planned,) = of(notes(out), f"{read_config(out)['steps']} steps planned for 1.5 s: ")
    assert planned in read_notes(out)
    assert len(of(notes(out), GROWTH)) == 1


def test_notes_are_not_stored_as_settings(scene, tmp_path):
    run(scene, tmp_path / "run", steps=2)
    stored = read_config(tmp_path / "run")
    assert "notes" not in stored
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0


@pytest.mark.parametrize(
    ("length", "known"), [({"max_views": 599}, 1), ({"max_views": 600}, 0), ({"seconds": 60.0}, 0)]
)
def test_a_dry_run_reports_that_density_control_is_off(scene, capsys, length, known):
    assert app.run({"scene": str(scene), **length}, dry_run=True, verbosity=-1) == 0
    assert capsys.readouterr().out.count(f"# {GROWTH}") == known
