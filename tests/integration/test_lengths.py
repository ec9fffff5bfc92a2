"""Lengths in views, events in views or steps, a K that changes: their schedule and counts."""

import csv

import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.run import app
from crossgrad_core.run.app import BUNDLED_SECONDS
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.results.config_file import read_config
from crossgrad_core.run.settings import merged, parsed
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.budget import PrimitiveCounts, cost_ahead, cost_of_run, seconds_ahead
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=9)


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "eval_every": 6, "threads": 1}
    assert app.run({**given, **settings}, verbosity=-1) == 0
    with (out / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def assembled(**settings):
    return assemble(parsed(settings), sample_scene(), "none")


class Watching:
    """Keeps the numbers of views and the events of every step."""

    def __init__(self):
        self.views, self.edits = [], []

    @hookimpl
    def crossgrad_step_end(self, record):
        self.views.append(len(record.views))
        if {"cloned", "split", "pruned"} & record.counts.keys():
            self.edits.append(sum(self.views))


def trained(**settings):
    """A run without a folder: its setup, state and what a plugin saw."""
    setup = assembled(**settings)
    state, seen = first_state(setup), Watching()
    while state.step < setup.schedule.total:
        seen.crossgrad_step_end(timed_step(setup, state))
    return setup, state, seen


@pytest.mark.slow
def test_evaluations_only_at_the_end_change_no_result(scene, tmp_path):
    often = run(scene, tmp_path / "often", steps=9, eval_every=2)
    late = run(scene, tmp_path / "late", steps=9, eval_every=2, eval_from=5)
    assert [row["step"] for row in often] == ["2", "4", "6", "8", "9"]
    assert [row["step"] for row in late] == ["6", "8", "9"]
    assert [row["psnr"] for row in late] == [row["psnr"] for row in often[2:]]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("margin", "told"), [(-100.0, True), (100.0, False)])
def test_a_run_that_ends_worse_than_an_earlier_step_reports_so(
    scene, tmp_path, monkeypatch, capsys, margin, told
):
    monkeypatch.setattr("crossgrad_core.run.finish.WORSE", margin)
    settings = {"scene": str(scene), "out": str(tmp_path / "run"), "steps": 4, "eval_every": 2}
    assert app.run(settings, verbosity=0) == 0
    line = "dB lower than at step"
    assert (line in capsys.readouterr().err) == told
    assert (line in (tmp_path / "run/log.txt").read_text()) == told


@pytest.mark.parametrize(
    ("views", "length", "steps", "drawn"),
    [(1, 13, 13, 13), (2, 13, 6, 12), ("1..2@0.5", 13, 8, 12), (3, 12, 4, 12)],
)
def test_a_length_in_views_is_converted_to_steps(views, length, steps, drawn):
    setup, state, seen = trained(views=views, max_views=length)
    assert (setup.schedule.total, setup.config.steps) == (steps, steps)
    assert setup.config.max_views is None
    assert sum(seen.views) == state.counters.views == drawn
    assert resolved(setup).views_per_step == views


def test_a_run_shorter_than_a_step_is_refused():
    with pytest.raises(UserError, match="at least 4, the number of views of the first step"):
        assembled(views=4, max_views=3)


def test_max_views_ends_a_run_before_its_seconds_are_used(scene, tmp_path):
    settings = {"seconds": 60.0, "max_views": 9, "views": 2, "sampler": {"name": "epoch"}}
    rows = run(scene, tmp_path / "run", **settings)
    assert (rows[-1]["step"], rows[-1]["views"]) == ("4", "8")
    stored = read_config(tmp_path / "run")
    assert (stored["steps"], stored["seconds"], stored["max_views"]) == (4, None, None)
    assert (stored["planned_seconds"], stored["planned_views"]) == (60.0, 9)
    assert stored["revisions"] == []
    assert "the limit on views allows 4" in (tmp_path / "run/log.txt").read_text()
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    again = (tmp_path / "again/point_cloud.ply").read_bytes()
    assert again == (tmp_path / "run/point_cloud.ply").read_bytes()


@pytest.mark.slow
def test_a_run_in_seconds_notes_reset_options_without_an_effect(scene, tmp_path):
    out, densifier = tmp_path / "run", {"name": "adc", "prune_scale": 0.3}
    run(scene, out, seconds=60.0, max_views=9, densifier=densifier)
    line = "densifier.prune_scale has no effect: the run has no opacity resets"
    assert line in (out / "log.txt").read_text()
    given = {"seconds": 60.0, "max_views": 9, "reset_every": 4, "densifier": densifier}
    run(scene, tmp_path / "resets", **given)
    assert line not in (tmp_path / "resets/log.txt").read_text()
    again = {**read_config(out), "out": str(tmp_path / "again")}
    assert app.run(again, verbosity=-1) == 0


@pytest.mark.slow
def test_seconds_end_a_run_before_max_views_is_reached(scene, tmp_path):
    rows = run(scene, tmp_path / "run", seconds=0.5, max_views=10**7)
    assert float(rows[-1]["train_seconds"]) < 5.0
    assert "the limit on views" not in (tmp_path / "run/log.txt").read_text()


@pytest.mark.slow
def test_a_resumed_run_with_seconds_and_max_views_ends_at_max_views(scene, tmp_path):
    out = tmp_path / "run"
    run(scene, tmp_path / "whole", seconds=60.0, max_views=12, rasterizer={"name": "torch"})
    rows = run(
        scene, out, seconds=60.0, max_views=12, stop_after=5, rasterizer={"name": "torch"}
    )  # fmt: skip
    assert rows[-1]["step"] == "5"
    assert app.run({}, resume=out, verbosity=-1) == 0
    whole = (tmp_path / "whole/point_cloud.ply").read_bytes()
    assert (out / "point_cloud.ply").read_bytes() == whole
    assert read_config(out)["planned_views"] == 12


def test_a_dry_run_with_seconds_and_max_views_prints_its_configuration(scene, tmp_path, capsys):
    given = {"scene": str(scene), "seconds": 60.0, "max_views": 500, "threads": 1}
    assert app.run(given, dry_run=True, verbosity=-1) == 0
    (tmp_path / "config.yaml").write_text(capsys.readouterr().out)
    again = merged(tmp_path / "config.yaml", {}, ())
    assert (again["seconds"], again["max_views"], again["steps"]) == (60.0, 500, None)
    assert merged(tmp_path / "config.yaml", {"seconds": 30.0}, ()).get("max_views") is None


@pytest.mark.parametrize("views", [9, "1..9@0.5"])
def test_a_dry_run_refuses_more_different_views_than_training_views(scene, views):
    given = {"scene": str(scene), "steps": 8, "views_per_step": views, "threads": 1}
    given["sampler"] = {"name": "epoch"}
    with pytest.raises(UserError, match="9 different views, but only 7 training views"):
        app.run(given, dry_run=True, verbosity=-1)


def test_max_views_with_seconds_must_cover_at_least_one_step():
    with pytest.raises(UserError, match="at least 4, the number of views of the first step"):
        assembled(views=4, max_views=3, seconds=1.0)


@pytest.mark.parametrize("lengths", [{"steps": 3, "max_views": 4}, {"seconds": 1, "steps": 4}])
def test_more_than_one_length_is_refused(lengths):
    with pytest.raises(UserError, match="more than one length"):
        app.with_defaults(RunConfig(**lengths))


@pytest.mark.parametrize(
    ("asked", "seconds", "views"),
    [
        ({}, BUNDLED_SECONDS, None),
        ({"seconds": 5.0}, 5.0, None),
        ({"max_views": 7}, None, 7),
    ],
)
def test_the_bundled_scene_has_its_own_default_length(asked, seconds, views):
    config = app.with_defaults(RunConfig(**asked))
    assert (config.seconds, config.max_views, config.steps) == (seconds, views, None)


def test_a_dry_run_with_seconds_prints_its_configuration(scene, tmp_path, capsys):
    settings = {"scene": str(scene), "seconds": 60.0, "threads": 1}
    assert app.run(settings, dry_run=True, verbosity=-1) == 0
    (tmp_path / "config.yaml").write_text(capsys.readouterr().out)
    again = merged(tmp_path / "config.yaml", {}, ())
    assert (again["seconds"], again["steps"]) == (60.0, None)
    assert app.run(again, dry_run=True, verbosity=-1) == 0


@pytest.mark.slow
def test_runs_with_one_and_two_views_per_step_edit_after_the_same_views():
    one, two = (trained(views=k, max_views=144, min_refinements=6)[2] for k in (1, 2))
    assert len(one.edits) == len(two.edits) == 6
    assert [count + count % 2 for count in one.edits] == two.edits
    assert max(one.edits) < 72


@pytest.mark.slow
def test_schedule_unit_steps_counts_events_in_steps():
    setup, _, seen = trained(views=2, steps=72, schedule_unit="steps")
    assert seen.edits == [] and setup.schedule.densify_from == 500
    given = {"densify_from": 10, "densify_every": 20, "densify_until": 60}
    assert trained(views=2, steps=72, schedule_unit="steps", **given)[2].edits == [40, 80]
    assert trained(views=2, steps=72, **given)[2].edits == [30, 50]


def test_k_follows_its_schedule_and_repeats_bit_for_bit(scene, tmp_path):
    settings = {"views": "1..2@0.5", "steps": 20, "sampler": {"name": "epoch"}}
    rows = run(scene, tmp_path / "whole", **settings)
    assert [(row["step"], row["views"]) for row in rows] == [
        ("6", "6"), ("12", "14"), ("18", "26"), ("20", "30"),
    ]  # fmt: skip
    stored = read_config(tmp_path / "whole")
    assert stored["views_per_step"] == "1..2@0.5" and stored["schedule_unit"] == "views"
    run(scene, tmp_path / "parts", stop_after=8, **settings)
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    states = [load(latest(tmp_path / name)).parameters for name in ("whole", "parts", "again")]
    for other in states[1:]:
        assert all(torch.equal(states[0][name], other[name]) for name in other)


@pytest.mark.parametrize("operator", ["gradvac", "gradnorm"])
def test_operators_with_memory_continue_when_k_changes(operator):
    _, state, seen = trained(
        views="1..3@0.3..2@0.6", steps=10, operator={"name": operator}, grouping={"name": "radial"}
    )
    assert seen.views == [1] * 3 + [3] * 3 + [2] * 4
    assert all(torch.isfinite(t).all() for t in state.parameters.values())


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"sampler": {"name": "near-far"}}, "sampler near-far needs .*; K is 1"),
        ({"operator": {"name": "anchors"}}, "operator anchors needs K = 2 .*; K is 1"),
    ],
)
def test_every_k_of_a_schedule_must_be_accepted_by_the_components(settings, why):
    with pytest.raises(IncompatibleSelectionError, match=why):
        assembled(views="1..2@0.5", steps=10, **settings)


@pytest.mark.parametrize(
    ("text", "form"), [("1..2", "A..B@SHARE"), ("1..1@0.5", "two different numbers")]
)
def test_an_invalid_views_value_is_refused_with_the_expected_form(text, form):
    with pytest.raises(UserError, match=form):
        parsed({"views": text})


def test_predicted_cost_counts_the_views_per_step_of_the_coming_steps():
    settings = {"steps": 1000, "densifier": {"name": "none"}}
    plain, changing = (assembled(views=views, **settings) for views in (2, "1..3@0.5"))
    crowd = PrimitiveCounts(start=100, present=100)
    assert cost_of_run(plain, crowd, 500) == cost_of_run(changing, crowd, 500) == 1000
    assert cost_ahead(changing, crowd, 500, 400) == 1200

    def ahead(run, step):
        state = first_state(run)
        state.step = step
        return seconds_ahead(run, state, 0.5)

    assert ahead(plain, 200) == 400.0
    assert ahead(changing, 200) == (300 + 1500) * 0.5
    assert ahead(changing, 500) == 1500 * 0.5
