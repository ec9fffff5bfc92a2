"""Whole runs on a tiny scene: results, repetition, resuming, failure, scaling."""

import csv
import json

import numpy as np
import pytest
import torch
from support.pace import each_step_takes
from support.scenes import write_tiny_scene

from crossgrad_core.contract.blocks import NO_EDIT, Edit, Rows
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import AggregateResult, DensifyResult, RegularizeResult
from crossgrad_core.run import app
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.results.config_file import read_config
from crossgrad_plugins.exporters.ply_file import read_ply

#: Density control within a few dozen steps; by default a run has to be longer.
GROWTH = {"schedule_unit": "steps", "densify_from": 10, "densify_until": 50, "densify_every": 10}
QUALITY = ("step", "views", "psnr", "ssim", "ssim_skimage", "primitives", "loss")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(folder, views=9)
    return folder


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": 12, "eval_every": 6, "threads": 1}
    return app.run({**given, **settings}, verbosity=-1)


def quality(out):
    with (out / "metrics.csv").open() as file:
        return [{name: row[name] for name in QUALITY} for row in csv.DictReader(file)]


def parameters(out):
    return load(latest(out)).parameters


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_writes_all_documented_files(scene, tmp_path, capsys, drawn):
    out = tmp_path / "run"
    assert run(scene, out) == 0
    assert (out / "curve.png").stat().st_size > 10_000
    names = {path.name for path in out.iterdir()}
    assert names >= {
        "config.yaml", "metrics.csv", "summary.json", "per_view.csv", "curve.png", "renders",
        "point_cloud.ply", "checkpoints", "log.txt",
    }  # fmt: skip
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "finished"
    assert summary["overall"]["psnr"] > 5
    assert summary["overall"]["lpips"] is None and summary["null"]["lpips"]
    assert summary["seconds"]["train"] > 0
    assert any("gradients of single views are not stored" in note for note in summary["notes"])
    assert str(out) in capsys.readouterr().out
    rows = quality(out)
    assert [row["step"] for row in rows] == ["6", "12"]
    assert rows[1]["views"] == "12"


def test_training_reduces_the_loss(scene, tmp_path):
    run(scene, tmp_path / "short", steps=2, eval_every=1)
    run(scene, tmp_path / "long", steps=120)
    first = float(quality(tmp_path / "short")[0]["psnr"])
    last = float(quality(tmp_path / "long")[-1]["psnr"])
    assert last > first + 2.0


def test_only_the_same_seed_gives_the_same_bits(scene, tmp_path):
    run(scene, tmp_path / "a")
    run(scene, tmp_path / "b")
    run(scene, tmp_path / "c", seed=1)
    assert quality(tmp_path / "a") == quality(tmp_path / "b")
    assert same(parameters(tmp_path / "a"), parameters(tmp_path / "b"))
    assert not same(parameters(tmp_path / "a"), parameters(tmp_path / "c"))


def test_the_written_config_repeats_the_run(scene, tmp_path):
    run(scene, tmp_path / "a", sampler={"name": "near-far"}, operator={"name": "symmetric"})
    stored = read_config(tmp_path / "a")
    assert app.run({**stored, "out": str(tmp_path / "b")}, verbosity=-1) == 0
    assert quality(tmp_path / "a") == quality(tmp_path / "b")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("sampler", ["epoch", "random", "near-far"])
def test_a_stopped_run_continues_bit_for_bit(scene, tmp_path, sampler):
    # Edits fall before and behind the stop.
    settings = {"steps": 40, "sampler": {"name": sampler}, "eval_every": 20, **GROWTH}
    run(scene, tmp_path / "whole", **settings)
    assert run(scene, tmp_path / "parts", stop_after=23, **settings) == 0
    assert json.loads((tmp_path / "parts/summary.json").read_text())["status"] == "stopped"
    assert read_config(tmp_path / "parts") == read_config(tmp_path / "whole")  # What repeats it.
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    whole, parts = load(latest(tmp_path / "whole")), load(latest(tmp_path / "parts"))
    assert same(whole.parameters, parts.parameters)
    assert same(whole.exp_avg, parts.exp_avg) and same(whole.exp_avg_sq, parts.exp_avg_sq)
    assert whole.generators == parts.generators
    rows = [row for row in quality(tmp_path / "parts") if row["step"] != "23"]
    assert rows == quality(tmp_path / "whole")


@pytest.mark.slow
def test_an_averaged_run_resumes_bit_for_bit_and_exports_the_average(scene, tmp_path):
    settings = {"steps": 20, "eval_every": 4}
    tail = {"lr-tail": {"share": 0.5}}
    settings["rules"] = {**tail, "weight-averaging": {"share": 0.5}}
    run(scene, tmp_path / "raw", **{**settings, "rules": tail})
    run(scene, tmp_path / "whole", **settings)
    assert run(scene, tmp_path / "parts", stop_after=15, **settings) == 0
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    whole, parts = load(latest(tmp_path / "whole")), load(latest(tmp_path / "parts"))
    assert same(whole.parameters, parts.parameters)
    assert same(whole.parameters, load(latest(tmp_path / "raw")).parameters)
    (one, two) = (each.plugins["weight-averaging"].per_primitive for each in (whole, parts))
    assert one and same(one, two)
    rows = [row for row in quality(tmp_path / "parts") if row["step"] != "15"]
    assert rows == quality(tmp_path / "whole")
    # The average of steps 11 to 20 begins after the evaluation of step 8.
    raw = quality(tmp_path / "raw")
    assert rows[:2] == raw[:2] and all(
        a["psnr"] != b["psnr"] for a, b in zip(rows[2:], raw[2:], strict=True)
    )
    exported = read_ply(tmp_path / "whole" / "point_cloud.ply").logit_opacities
    sums, count = whole.plugins["weight-averaging"].per_primitive["opacities"], 10
    assert np.allclose(
        np.sort(exported.ravel()), np.sort((sums / count).numpy().ravel()), atol=1e-5
    )


def test_the_configuration_of_a_run_with_a_time_budget_repeats_it_bit_for_bit(
    scene, tmp_path, monkeypatch
):
    # Whatever the probe of this machine says, the first plan is wrong.
    monkeypatch.setattr(app, "steps_for", lambda setup, seconds: (40, "forty steps", 0.6))
    each_step_takes(monkeypatch, 0.025)
    run(scene, tmp_path / "timed", steps=None, seconds=1.5, **GROWTH)
    stored = read_config(tmp_path / "timed")
    assert (stored["steps"], stored["seconds"], stored["planned_seconds"]) == (40, None, 1.5)
    last = load(latest(tmp_path / "timed")).step
    assert stored["revisions"][-1][1] == last == 60
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    assert quality(tmp_path / "timed") == quality(tmp_path / "again")
    assert same(parameters(tmp_path / "timed"), parameters(tmp_path / "again"))


@pytest.mark.slow
def test_notes_that_a_changed_length_makes_wrong_are_withdrawn(
    scene, tmp_path, monkeypatch, capsys
):
    # The plan is too short for density control (it would end in step 14), the run is not.
    monkeypatch.setattr(app, "steps_for", lambda setup, seconds: (28, "few steps", 0.6))
    each_step_takes(monkeypatch, 0.05)
    times = {"schedule_unit": "steps", "densify_from": 13, "densify_every": 1}
    settings = {**times, "steps": None, "seconds": 3.0}
    given = {"scene": str(scene), "out": str(tmp_path / "timed"), "threads": 1, **settings}
    assert app.run(given, verbosity=0) == 0
    summary = json.loads((tmp_path / "timed" / "summary.json").read_text())
    told = [line for line in capsys.readouterr().err.splitlines() if "density control" in line]
    logged = (tmp_path / "timed" / "log.txt").read_text()
    assert summary["step"] == 60
    assert not any("no density control" in note for note in summary["notes"])
    assert (
        f"adapted to the time budget: {summary['step']} steps instead of 28" in summary["notes"][-1]
    )
    assert "no density control" in logged
    (line,) = told
    assert line.startswith("density control is used after all") and line in logged


@pytest.mark.slow
def test_a_stopped_run_resumes_with_the_length_revised_at_its_step(scene, tmp_path):
    lengths = {"steps": 30, "revisions": [[10, 50], [20, 44], [34, 48]]}
    assert run(scene, tmp_path / "whole", **lengths) == 0
    assert load(latest(tmp_path / "whole")).step == 48
    assert run(scene, tmp_path / "parts", stop_after=20, **lengths) == 0
    written = (tmp_path / "parts" / "config.yaml").read_bytes()
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    assert same(parameters(tmp_path / "whole"), parameters(tmp_path / "parts"))
    assert (tmp_path / "parts" / "config.yaml").read_bytes() == written


@pytest.mark.slow
def test_a_run_that_started_from_a_file_can_be_resumed_without_the_file(scene, tmp_path):
    run(scene, tmp_path / "source", steps=3)
    cloud = tmp_path / "cloud.ply"
    cloud.write_bytes((tmp_path / "source" / "point_cloud.ply").read_bytes())
    settings = {"steps": 12, "data": {"init": str(cloud)}}
    run(scene, tmp_path / "whole", **settings)
    run(scene, tmp_path / "parts", stop_after=5, **settings)
    cloud.unlink()
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    assert same(parameters(tmp_path / "whole"), parameters(tmp_path / "parts"))


@pytest.mark.slow
def test_separate_gradients_kept_for_an_observer_give_the_same_bits(scene, tmp_path, monkeypatch):
    from crossgrad_core.training.setup import Setup

    run(scene, tmp_path / "accumulated", steps=45, **GROWTH)
    monkeypatch.setattr(Setup, "separate", True)
    run(scene, tmp_path / "apart", steps=45, **GROWTH)
    first, second = (load(latest(tmp_path / name)) for name in ("accumulated", "apart"))
    assert same(first.parameters, second.parameters)
    assert same(first.plugins["densifier"].per_primitive, second.plugins["densifier"].per_primitive)


def test_joint_backward_agrees_with_separate_backward_to_rounding_and_counts_one_pass(
    scene, tmp_path
):
    run(scene, tmp_path / "separate", steps=3, eval_every=3)
    run(scene, tmp_path / "joint", steps=3, eval_every=3, backward="joint")
    first, second = parameters(tmp_path / "separate"), parameters(tmp_path / "joint")
    for name in first:
        assert torch.allclose(first[name], second[name], rtol=1e-4, atol=1e-5), name
    with (tmp_path / "joint" / "metrics.csv").open() as file:
        assert next(csv.DictReader(file))["backward_passes"] == "3"


@pytest.fixture(scope="module")
def in_place(scene, tmp_path_factory):
    """A run of the scene in its own unit and place."""
    out = tmp_path_factory.mktemp("in place") / "run"
    run(scene, out, steps=40)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1000.0, 0.001])
def test_the_unit_of_length_of_a_scene_does_not_change_the_result(in_place, tmp_path, scale):
    write_tiny_scene(tmp_path / "scaled", views=9, scale=scale)
    run(tmp_path / "scaled", tmp_path / "b", steps=40)
    a, b = quality(in_place)[-1], quality(tmp_path / "b")[-1]
    assert float(a["psnr"]) == pytest.approx(float(b["psnr"]), abs=1e-3)
    assert a["primitives"] == b["primitives"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("offset", [(4e5, 5.6e6, 120.0), (1e6, 1e6, 1e6)])
def test_an_export_far_from_the_origin_has_the_right_position(in_place, tmp_path, offset):
    write_tiny_scene(tmp_path / "utm", views=9, offset=offset)
    run(tmp_path / "utm", tmp_path / "b", steps=40)
    near = read_ply(in_place / "point_cloud.ply").means
    far = read_ply(tmp_path / "b" / "point_cloud.ply").means
    assert np.abs(np.median(far, 0) - np.median(near, 0) - np.array(offset)).max() < 0.05


@pytest.mark.sampled(1)
@pytest.mark.parametrize("views", [1, 2, 3])
def test_any_number_of_views_can_have_photos_of_different_sizes(tmp_path, views):
    write_tiny_scene(tmp_path / "mixed", views=6, mixed=True, folders=("aerial", "street"))
    assert run(tmp_path / "mixed", tmp_path / "run", views=views) == 0
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert set(summary["regimes"]) == {"aerial", "street"}


@pytest.mark.slow
def test_the_published_recipe_trains_and_gives_different_parameters(scene, tmp_path):
    assert run(scene, tmp_path / "a", recipe={"name": "published"}, steps=60, **GROWTH) == 0
    run(scene, tmp_path / "b", steps=60, **GROWTH)
    assert not same(parameters(tmp_path / "a"), parameters(tmp_path / "b"))


def test_a_short_run_without_density_control_reports_so(scene, tmp_path):
    run(scene, tmp_path / "run", steps=4, initializer={"name": "points"})
    assert quality(tmp_path / "run")[-1]["primitives"] == "200"
    assert "no density control" in (tmp_path / "run" / "log.txt").read_text()


def test_growth_stops_at_max_gaussians_with_a_message(scene, tmp_path):
    # Every Gaussian is above a threshold of 1e-12, so the first edit wants to double them all.
    settings = {"steps": 60, **GROWTH, "densifier": {"name": "adc", "grad_threshold": 1e-12}}
    settings["initializer"] = {"name": "points"}
    settings["rate_factor"] = 1.0  # With larger rates some become transparent and are pruned.
    run(scene, tmp_path / "run", max_gaussians=230, **settings)
    assert int(quality(tmp_path / "run")[-1]["primitives"]) <= 230
    assert "were not added" in (tmp_path / "run" / "log.txt").read_text()
    # On a curve growth is held back at every edit, as it should be.
    run(scene, tmp_path / "curve", max_gaussians=230, growth="budget", **settings)
    assert quality(tmp_path / "curve")[-1]["primitives"] == "230"
    assert "were not added" not in (tmp_path / "curve" / "log.txt").read_text()
    summary = json.loads((tmp_path / "curve/summary.json").read_text())
    assert summary["peak_primitives"] == 230


def test_max_gaussians_below_the_number_of_points_is_applied_and_reported(scene, tmp_path):
    run(
        scene,
        tmp_path / "run",
        steps=60,
        max_gaussians=90,
        **GROWTH,
        initializer={"name": "points"},
    )
    counts = [int(row["primitives"]) for row in quality(tmp_path / "run")]
    assert max(counts) <= 90
    told = "start: 60 Gaussians instead of 200"
    assert told in (tmp_path / "run/log.txt").read_text()
    notes = json.loads((tmp_path / "run/summary.json").read_text())["notes"]
    assert any(told in note for note in notes)


class Poison:
    """Turns one parameter into NaN by way of an edit, in given steps."""

    def __init__(self, steps):
        self.steps = set(steps)

    @hookimpl
    def crossgrad_after_step(self, context):
        if context.step not in self.steps:
            return None
        self.steps.discard(context.step)
        bad = context.parameters["f_dc"].detach().clone()
        bad[:] = float("nan")
        return DensifyResult(Edit(values={"f_dc": Rows(bad)}))


def poisoned(monkeypatch, poison):
    from crossgrad_core.run import assemble

    original = assemble._plugins
    monkeypatch.setattr(assemble, "_plugins", lambda *args: {**original(*args), "poison": poison})


def test_one_non_finite_step_is_rewound(scene, tmp_path, monkeypatch):
    poisoned(monkeypatch, Poison([7]))
    assert run(scene, tmp_path / "run", save_every=100) == 0
    assert "training returned to step 0" in (tmp_path / "run" / "log.txt").read_text()
    # The evaluation of step 6 was before the rewind and is there once, from after it.
    assert [row["step"] for row in quality(tmp_path / "run")] == ["6", "12"]
    assert all(torch.isfinite(t).all() for t in parameters(tmp_path / "run").values())


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seconds", [0.001, 1.0])
def test_the_rewind_step_does_not_depend_on_the_clock(scene, tmp_path, monkeypatch, seconds):
    each_step_takes(monkeypatch, seconds)  # Of a second: the run thinks about its length at once.
    poisoned(monkeypatch, Poison([7]))
    assert run(scene, tmp_path / "run", save_every=100) == 0
    assert "training returned to step 0" in (tmp_path / "run" / "log.txt").read_text()


@pytest.mark.slow
def test_a_run_with_a_time_budget_and_a_rewind_can_be_repeated(scene, tmp_path, monkeypatch):
    each_step_takes(monkeypatch, 1.0)
    poisoned(monkeypatch, Poison([17]))
    given = {"scene": str(scene), "save_every": 1000, "eval_every": 1000}
    assert app.run({**given, "seconds": 20.0, "out": str(tmp_path / "timed")}, verbosity=-1) == 0
    poisoned(monkeypatch, Poison([17]))
    stored = read_config(tmp_path / "timed")
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    assert same(parameters(tmp_path / "timed"), parameters(tmp_path / "again"))


def test_a_non_finite_value_right_before_a_length_revision_is_rewound(scene, tmp_path, monkeypatch):
    poisoned(monkeypatch, Poison([7]))
    assert run(scene, tmp_path / "run", save_every=100, revisions=[[4, 12], [7, 12]]) == 0
    assert "training returned to step 4" in (tmp_path / "run" / "log.txt").read_text()
    assert all(torch.isfinite(t).all() for t in parameters(tmp_path / "run").values())


def test_a_second_non_finite_step_stops_the_run_and_names_step_view_and_cause(
    scene, tmp_path, monkeypatch, capsys
):
    # Found at the next look at all parameters, in steps 10 and 20.
    poisoned(monkeypatch, Poison([5, 17]))
    assert run(scene, tmp_path / "run", steps=30, save_every=100, eval_every=100) == 1
    message = capsys.readouterr().err
    assert "block f_dc is not finite in step 20" in message
    assert ".png" in message
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["status"] == "failed" and "not finite" in summary["error"]


class Louder:
    """Wraps all three hooks and adds a loss term; counts what it saw."""

    def __init__(self):
        self.seen = []

    @hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        sampled = yield
        self.seen.append("sample")
        return sampled

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        aggregated = yield
        self.seen.append("aggregate")
        zeroed = dict.fromkeys(aggregated.gradients)
        return AggregateResult(zeroed, aggregated.counts, states=aggregated.states)

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        densified = yield
        self.seen.append("densify")
        return DensifyResult(NO_EDIT, states=densified.states)

    @hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is not None:
            return None
        return RegularizeResult(context.parameters["opacities"].sum())


def test_hook_wrappers_replace_the_results_of_hooks(scene, tmp_path, monkeypatch):
    watcher = Louder()
    poisoned(monkeypatch, watcher)
    run(scene, tmp_path / "run", steps=4, eval_every=4)
    run_parameters = load(latest(tmp_path / "run"))
    assert watcher.seen == ["sample", "aggregate", "densify"] * 4
    # Only the loss term's gradient is left: nothing but the opacities has moved.
    assert set(run_parameters.adam_steps) >= {"opacities"}
    moved = {name for name, steps in run_parameters.adam_steps.items() if steps > 0}
    assert moved == {"opacities"}
