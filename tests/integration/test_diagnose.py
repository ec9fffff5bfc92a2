"""Diagnostics of whole runs: the command, and the observer that changes no bit."""

import csv
from dataclasses import replace

import pytest
import torch
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.cli.main import main
from crossgrad_core.config import ComponentChoice
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.training import loop
from crossgrad_core.training.state import NonFiniteError
from crossgrad_plugins.diagnostics import figure
from crossgrad_plugins.diagnostics.app import Options, diagnose

PROBED = {"diagnostics.csv", "cameras.csv", "groupings.csv", "diagnostics.png"}
FILES = {*PROBED, "exposure.csv", "exposure.png"}
QUICK = Options(per_group=4, probes=2, seconds=1.0)


@pytest.fixture(autouse=True)
def _without_pictures(request, monkeypatch):
    """Drawing takes half of the time of these tests; those that want pictures ask for `drawn`."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(figure, "draw", lambda *_: b"a picture")
        monkeypatch.setattr(figure, "draw_exposure", lambda *_: b"a picture")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(folder, views=9, folders=("street", "aerial"))
    return folder


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": 12, "eval_every": 12, "threads": 1}
    assert app.run({**given, **settings}, verbosity=-1) == 0
    return load(latest(out))


def table(folder):
    with (folder / "diagnostics.csv").open() as file:
        return list(csv.DictReader(file))


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


OBSERVER = {"name": "diagnostics", "every": 6, "views": 4}


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"sampler": {"name": "epoch"}, "operator": {"name": "sum"}},
        {"sampler": {"name": "near-far"}, "operator": {"name": "symmetric"}},
        {"sampler": {"name": "random"}, "background": "random"},
    ],
    ids=["one view", "pair", "random background"],
)
def test_the_diagnostics_observer_changes_no_bit_of_the_training(scene, tmp_path, settings):
    plain = run(scene, tmp_path / "plain", **settings)
    watched = run(scene, tmp_path / "watched", observers=[OBSERVER], **settings)
    assert same(plain.parameters, watched.parameters)
    assert same(plain.exp_avg, watched.exp_avg)
    assert same(plain.exp_avg_sq, watched.exp_avg_sq)
    assert plain.generators == watched.generators
    assert {path.name for path in (tmp_path / "watched").iterdir()} >= PROBED
    assert sorted({int(row["step"]) for row in table(tmp_path / "watched")}) == [6, 12]


@pytest.mark.slow
def test_a_gradient_probe_uses_the_grouping_of_the_run(scene, tmp_path):
    settings = {"sampler": {"name": "near-far"}, "grouping": {"name": "lists"}}
    run(scene, tmp_path / "run", observers=[OBSERVER], **settings)
    assert {row["grouping"] for row in table(tmp_path / "run")} == {"of the run"}


@pytest.mark.slow
def test_each_gradient_probe_records_its_duration(scene, tmp_path):
    run(scene, tmp_path / "run", steps=4, observers=[{**OBSERVER, "every": 1}])
    probing = {row["step"]: float(row["probe_seconds"]) for row in table(tmp_path / "run")}
    assert len(probing) == 4
    assert all(seconds > 0 for seconds in probing.values())


@pytest.mark.slow
def test_a_resumed_run_continues_its_diagnostics_table(scene, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run(scene, whole, observers=[OBSERVER])
    run(scene, parts, observers=[OBSERVER], stop_after=7)
    assert app.run({}, resume=parts, verbosity=-1) == 0

    def figures(folder):
        return [{k: v for k, v in row.items() if k != "probe_seconds"} for row in table(folder)]

    assert figures(parts) == figures(whole)


@pytest.mark.usefixtures("drawn")
def test_a_scene_is_diagnosed_on_a_short_vanilla_run(scene, tmp_path, capsys):
    diagnose(scene, None, {"threads": 1}, QUICK, tmp_path / "out")
    printed = capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert "model: a vanilla run of" in printed
    assert "not georeferenced: neither the scene files nor the photos" in printed
    assert "Sarle's bimodality" in printed
    assert "the exposures need no model" in printed
    rows = table(tmp_path / "out")
    assert len({row["step"] for row in rows}) == 2
    assert {row["metric"] for row in rows} == {"plain", "adam"}
    assert {"means", "opacities", "all"} <= {row["block"] for row in rows}
    for name in ("diagnostics.png", "exposure.png"):
        assert (tmp_path / "out" / name).read_bytes()[:4] == b"\x89PNG"


def test_a_finished_run_is_diagnosed_at_its_final_state(scene, tmp_path, capsys):
    settings = {"sampler": {"name": "near-far"}, "operator": {"name": "symmetric"}}
    run(scene, tmp_path / "run", **settings)
    arguments = ["diagnose", "--run", str(tmp_path / "run"), "--views", "3", "--threads", "1"]
    with pytest.raises(SystemExit) as end:
        main([*arguments, "--out", str(tmp_path / "out")])
    assert not end.value.code
    printed = capsys.readouterr().out
    assert f"run {tmp_path / 'run'} (vanilla, near-far, symmetric) at step 12" in printed
    assert {row["step"] for row in table(tmp_path / "out")} == {"12"}
    assert {row["near_views"] for row in table(tmp_path / "out")} == {"3"}
    assert {row["grouping"] for row in table(tmp_path / "out")} == {"of the run"}


@pytest.mark.slow
def test_a_sampler_can_use_the_labels_of_the_conflict_signature(scene, tmp_path):
    run(scene, tmp_path / "run")
    labels = tmp_path / "labels.csv"
    options = Options(per_group=4, signature=labels)
    diagnose(None, tmp_path / "run", {"threads": 1}, options, tmp_path / "out")
    names = {line.split(",")[1] for line in labels.read_text().splitlines()}
    assert names == {"near", "far"}
    grouping = {"name": "lists", "file": str(labels)}
    run(scene, tmp_path / "second", sampler={"name": "near-far"}, grouping=grouping)


def test_invalid_diagnose_requests_are_refused(scene, tmp_path):
    with pytest.raises(UserError, match="both a scene and a run"):
        diagnose(scene, tmp_path, {}, QUICK, None)
    with pytest.raises(UserError, match="nosuch"):
        diagnose(scene, None, {}, Options(grouping=ComponentChoice(name="nosuch")), tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "diagnostics.csv").touch()
    with pytest.raises(UserError, match="already contains a report"):
        diagnose(scene, None, {}, QUICK, tmp_path / "b")
    with pytest.raises(UserError, match="not the folder of a run"):
        diagnose(None, tmp_path, {}, QUICK, tmp_path / "c")


@pytest.mark.parametrize("photos", [1, 2, 3])
def test_too_few_photos_are_refused_with_the_required_number(tmp_path, photos):
    scene = write_tiny_scene(tmp_path / "few", views=photos)
    with pytest.raises(UserError) as told:
        diagnose(scene, None, {"threads": 1}, QUICK, tmp_path / "out")
    assert told.value.what == "the scene has too few training photos for a probe"
    assert "at least 4" in told.value.expected and "sampler" not in told.value.todo


@pytest.mark.parametrize("name", sorted(FILES - {"diagnostics.csv"}))
def test_no_file_of_the_user_is_overwritten(scene, tmp_path, name):
    mine = tmp_path / name
    mine.write_text("mine")
    for options, out in ((QUICK, tmp_path), (replace(QUICK, signature=mine), tmp_path / "out")):
        with pytest.raises(UserError, match="the output file already exists"):
            diagnose(scene, None, {"threads": 1}, options, out)
        assert mine.read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ("--run", "RUN", "--seconds", "60"),
        ("--run", "RUN", "--probes", "4"),
        ("--run", "RUN", "--max-size", "60"),
        ("--accept-scene",),
    ],
)
def test_options_without_an_effect_are_refused(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert ended("diagnose", *arguments) == 2
    assert f"{arguments[-2 if len(arguments) > 1 else 0]} has no effect" in capsys.readouterr().err


def failing_from(monkeypatch, first):
    """Lets every step from `first` on find something that is not finite."""
    step = loop.take_step

    def failing(setup, state):
        record = step(setup, state)
        if state.step >= first:
            raise NonFiniteError(state.step, record.names, "the gradient of block means")
        return record

    monkeypatch.setattr(loop, "take_step", failing)


def diagnosed(scene, out):
    with pytest.raises(SystemExit) as end:
        main(["diagnose", str(scene), "--seconds", "1", "--views", "3", "--threads", "1",
              "--out", str(out)])  # fmt: skip
    return end.value.code


@pytest.mark.slow
def test_a_failed_training_reports_its_gradient_probes_and_the_reason(
    scene, tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr("crossgrad_plugins.diagnostics.app.affordable_steps", lambda *given: 40)
    failing_from(monkeypatch, 25)
    assert diagnosed(scene, tmp_path / "out") == 1
    printed = capfd.readouterr()
    assert "training failed: the gradient of block means" in printed.err
    assert "Traceback" not in printed.err
    assert "which failed; the probes before the failure are shown" in printed.out
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert {row["step"] for row in table(tmp_path / "out")} == {"10", "20"}


@pytest.mark.parametrize("compiling", [True, False], ids=["compiling", "training"])
def test_a_training_that_fails_before_the_first_gradient_probe_is_reported(
    scene, tmp_path, monkeypatch, capfd, compiling
):
    if not compiling:
        monkeypatch.setattr("crossgrad_plugins.diagnostics.app.affordable_steps", lambda *given: 40)
    failing_from(monkeypatch, 1)
    assert diagnosed(scene, tmp_path / "out") == 1
    printed = capfd.readouterr()
    assert "nothing was probed before" in printed.err
    assert "Traceback" not in printed.err
    assert not (tmp_path / "out").exists()
