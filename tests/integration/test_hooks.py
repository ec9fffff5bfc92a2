"""Plugins of the smaller hooks in short runs: each does what it says, also stopped and resumed."""

import csv
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.distributions import installed
from support.scenes import write_tiny_scene
from support.selections import selection_of

from crossgrad_core.contract.objections import objections_to
from crossgrad_core.errors import UserError
from crossgrad_core.plugin import AggregateResult, Observer, Operator, ViewCounts, hookimpl
from crossgrad_core.registry.entries import load as load_plugin
from crossgrad_core.run import app, assemble
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.testing.checking import checks_of
from crossgrad_core.training.state import PHASES
from crossgrad_core.training.views import RenderCallback

PLUGINS = {
    "resolutions": {"near-at-half": "support.hook_plugins:NearAtHalf"},
    "densifiers": {"unseen": "support.hook_plugins:PrunesTheUnseen"},
    "samplers": {"one-then-two": "support.hook_plugins:OneThenTwo"},
    "exposures": {"stops": "support.hook_plugins:GainPerPhoto"},
    "losses": {"centre": "support.hook_plugins:CentreWeighted"},
    "metrics": {"brightness": "support.hook_plugins:BrightnessError"},
}
#: Two edits and a reset in a few steps.
WINDOW = {"densify_from": 4, "densify_until": 22, "densify_every": 6}
GROWTH = {"schedule_unit": "steps", "reset_every": 13, **WINDOW}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=5, folders=("near", "far"))


@pytest.fixture(autouse=True)
def _plugins(tmp_path, monkeypatch):
    installed(tmp_path / "plugins", monkeypatch, PLUGINS)


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": 24, "eval_every": 12, "threads": 1}
    reading = {"max_size": 40}
    return app.run({**given, "data": reading, **GROWTH, **settings}, verbosity=-1)


def resumed(scene, out, **settings):
    assert run(scene, out, stop_after=11, **settings) == 0
    return app.run({}, resume=out, verbosity=-1)


def state_of(out):
    """Everything by which two runs may differ but clocks."""
    found = load(latest(out))
    last = {name: value for name, value in found.scalars["last"].items() if "seconds" not in name}
    states = {name: (state.values, state.tensors) for name, state in found.plugins.items()}
    return {**found.parameters, **{f"m {k}": v for k, v in found.exp_avg.items()}}, last, states


def same(one, other):
    (tensors, last, states), (tensors_b, last_b, states_b) = state_of(one), state_of(other)
    assert tensors.keys() == tensors_b.keys()
    assert all(torch.equal(tensors[name], tensors_b[name]) for name in tensors)
    assert last == last_b
    assert states.keys() == states_b.keys()
    for name, (values, kept) in states.items():
        assert values == states_b[name][0]
        assert all(torch.equal(kept[key], states_b[name][1][key]) for key in kept)


def rows(out):
    with (out / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


CHECKS = [
    pytest.param(slot, name, check, id=f"{name}-{check.__name__}")
    for slot, names in PLUGINS.items()
    for name in names
    for check in checks_of(slot)
]


@pytest.mark.sampled(26)
@pytest.mark.parametrize(("slot", "name", "check"), CHECKS)
def test_each_plugin_keeps_the_contract_of_its_slot(slot, name, check):
    check(load_plugin(slot, name))


ALTOGETHER = {
    "resolution": {"name": "near-at-half"},
    "exposure": {"name": "stops"},
    "loss": {"name": "centre"},
    "metrics": [{"name": "psnr"}, {"name": "brightness"}],
}
CASES = {
    "sampler and operator that follow losses": {
        "sampler": {"name": "active"}, "operator": {"name": "gradnorm"}
    },
    "anchors": {
        "backbone": {"name": "scaffold"}, "sampler": {"name": "near-far"}, "reset_every": None
    },
    "pixel statistics": {"densifier": {"name": "pixel"}, "views": 3},
    "extra renders and a K that changes": {
        "densifier": {"name": "unseen"}, "sampler": {"name": "one-then-two"}, "views": 2,
        "operator": {"name": "pcgrad"},
    },
    "a K that changes, summed up": {"sampler": {"name": "one-then-two"}, "views": 3},
    "joint backward": {"backward": "joint", "densifier": {"name": "dc4gs"}},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_resumed_run_ends_with_the_bits_of_an_uninterrupted_run(scene, tmp_path, case):
    settings = {**ALTOGETHER, **CASES[case]}
    assert run(scene, tmp_path / "whole", **settings) == 0
    assert resumed(scene, tmp_path / "broken", **settings) == 0
    same(tmp_path / "whole", tmp_path / "broken")


def test_the_record_of_a_step_contains_the_render_scales(scene, tmp_path):
    assert run(scene, tmp_path / "run", **ALTOGETHER, sampler={"name": "near-far"}, views=2) == 0
    last = load(latest(tmp_path / "run")).scalars["last"]
    expected = [0.5 if name.startswith("near") else 1.0 for name in last["names"]]
    assert sorted(last["scales"]) == [0.5, 1.0]
    assert last["scales"] == expected


def test_extra_renders_are_counted_and_take_training_time(scene, tmp_path):
    settings = {**ALTOGETHER, "densifier": {"name": "unseen"}, "sampler": {"name": "one-then-two"}}
    assert run(scene, tmp_path / "run", **settings, reset_every=None) == 0
    edits = load(latest(tmp_path / "run")).plugins["densifier"].values["losses"]
    # 12 steps of one view, 12 of two, and two extra renders at each edit.
    assert [len(losses) for losses in edits] == [2] * len(edits)
    assert len(edits) >= 2
    assert rows(tmp_path / "run")[-1]["views"] == str(36 + 2 * len(edits))
    assert all(0.0 < loss < 1.0 for losses in edits for loss in losses)


def test_a_requested_render_equals_the_image_of_training(scene, tmp_path):
    asked = []

    class Asks(Observer):
        @hookimpl
        def crossgrad_model_ready(self, model):
            drawn = model.render(1, 0.5, frozenset({"depth"}))
            assert drawn.render.depth.shape == drawn.photo.shape[:2] == drawn.image.shape[:2]
            expected = model.loss.loss(drawn.image, drawn.photo, drawn.mask, None)
            found = drawn.loss
            asked.append((float(found.detach()), float(expected.detach()), found.requires_grad))

    build = assemble.make_manager
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assemble, "make_manager", lambda plugins: build({**plugins, "asks": Asks()}))
        assert run(scene, tmp_path / "run", steps=3, exposure={"name": "stops"}) == 0
    assert len(asked) == 3
    assert all(loss == expected and differentiable for loss, expected, differentiable in asked)
    assert rows(tmp_path / "run")[-1]["views"] == "3"


@pytest.mark.parametrize(("view", "scale"), [(-1, 1.0), (99, 1.0), (0, 0.0), (0, 1.5)])
def test_an_impossible_render_request_is_refused(view, scale):
    setup = SimpleNamespace(train_views=(None,) * 3)
    with pytest.raises(UserError, match="requested a render"):
        RenderCallback(setup, None, counted=False)(view, scale)


class PairOnly(Operator):
    """Means something for two views only."""

    views = ViewCounts(2, 2)

    def aggregate(self, context, state):
        return AggregateResult(context.gradients.total()), state


def test_an_operator_that_cannot_use_the_views_of_some_step_is_refused():
    selection = selection_of(
        sampler=load_plugin("samplers", "one-then-two")(), operator=PairOnly(), views_per_step=2
    )
    assert any("steps have 1, 2 views" in reason for reason in objections_to(selection))


class Quarter(Observer):
    """Wraps the hook of the scales: everything at a quarter."""

    @hookimpl(wrapper=True)
    def crossgrad_choose_scales(self, context):
        answer = yield
        return replace(answer, scales=tuple(0.25 for _ in answer.scales))


def test_the_hook_of_render_scales_can_be_wrapped(scene, tmp_path, monkeypatch):
    build = assemble.make_manager
    monkeypatch.setattr(
        assemble, "make_manager", lambda plugins: build({**plugins, "quarter": Quarter()})
    )
    assert run(scene, tmp_path / "run", views=2) == 0
    assert load(latest(tmp_path / "run")).scalars["last"]["scales"] == [0.25, 0.25]


def test_a_plugin_metric_adds_columns_and_its_name_creates_no_regime(scene, tmp_path):
    assert run(scene, tmp_path / "run", **ALTOGETHER) == 0
    columns = list(rows(tmp_path / "run")[0])
    assert columns[5:11] == [
        "psnr", "psnr_cc", "psnr_far", "psnr_cc_far", "psnr_near", "psnr_cc_near",
    ]  # fmt: skip
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert list(summary["regimes"]) == ["far", "near"]
    assert summary["overall"].keys() == {"views", "psnr", "psnr_cc"}
    assert summary["definitions"]["psnr_cc"] == "mean error"


def dimmed(scene, folder, stops):
    """The scene with every other photo that many stops darker."""
    shutil.copytree(scene, folder)
    for path in sorted(folder.glob("images/*/*.png"))[::2]:
        photo = np.asarray(Image.open(path), dtype=np.float64)
        Image.fromarray((photo * 2.0**-stops).round().astype(np.uint8)).save(path)
    return folder


def stops_of(out):
    state = load(latest(out)).plugins["photos"]
    return dict(zip(state.values["photos"], state.tensors["value.stops"].tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("backbone", ["vanilla", "scaffold"])
def test_gains_per_photo_identify_the_darker_photos(scene, tmp_path, views, backbone):
    dark = dimmed(scene, tmp_path / "dark", 1.0)
    settings = {"steps": 90 // views, "views": views, "reset_every": None}
    exposure = {"name": "stops", "lr": 0.1}
    chosen = {"backbone": {"name": backbone}, "operator": {"name": "mean"}, "exposure": exposure}
    assert run(dark, tmp_path / "run", **settings, **chosen) == 0
    stops = stops_of(tmp_path / "run")
    names = sorted(path.relative_to(dark / "images").as_posix() for path in dark.rglob("*.png"))
    dim = [stops[name] for name in names[::2] if name in stops]
    bright = [stops[name] for name in names[1::2] if name in stops]
    assert max(dim) < min(bright)
    assert sum(stops.values()) == pytest.approx(0.0, abs=1e-5)


def test_exposures_of_photos_not_rendered_in_a_step_change_by_the_projection_only(scene, tmp_path):
    assert run(scene, tmp_path / "run", steps=1, exposure={"name": "stops"}, views=1) == 0
    stops = stops_of(tmp_path / "run")
    drawn = load(latest(tmp_path / "run")).scalars["last"]["names"]
    rest = {value for name, value in stops.items() if name not in drawn}
    assert len(drawn) == 1 and len(rest) == 1
    # One step of Adam is as long as its rate; the projection takes a share of it from all.
    assert abs(stops[drawn[0]] - rest.pop()) == pytest.approx(0.05, rel=1e-4)


def test_a_run_without_an_exposure_stores_no_values_per_photo(scene, tmp_path):
    assert run(scene, tmp_path / "run", steps=2) == 0
    assert "photos" not in load(latest(tmp_path / "run")).plugins


def test_training_seconds_are_reported_by_phase(scene, tmp_path):
    assert resumed(scene, tmp_path / "run", **ALTOGETHER) == 0
    seconds = json.loads((tmp_path / "run" / "summary.json").read_text())["seconds"]
    assert list(seconds["phases"]) == list(PHASES)
    assert sum(seconds["phases"].values()) == pytest.approx(seconds["train"], rel=1e-9)
    assert all(seconds["phases"][phase] > 0 for phase in PHASES)


def test_two_columns_with_the_same_name_are_refused(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=4, folders=("cc", "far"))
    with pytest.raises(UserError, match="psnr_cc") as caught:
        run(scene, tmp_path / "run", **ALTOGETHER)
    assert "rename the folder" in caught.value.todo
    assert not (tmp_path / "run").exists()


def test_render_scales_out_of_bounds_end_the_run_and_name_the_plugin(
    scene, tmp_path, monkeypatch, capsys
):
    from support.hook_plugins import NearAtHalf

    monkeypatch.setattr(NearAtHalf, "scales", lambda self, context, state: ((2.0, 1.0), state))
    with pytest.raises(UserError, match="returned a wrong scale"):
        run(scene, tmp_path / "run", resolution={"name": "near-at-half"})


class Between(Observer):
    """Pauses twice after each step, reads the model, and stops the run after step 3."""

    def __init__(self, stops):
        super().__init__()
        self._calls, self._stops = [], stops

    @hookimpl
    def crossgrad_between_steps(self, model):
        shown = model()
        self._calls.append(shown.phase.step)
        assert not shown.phase.training
        if self._calls.count(shown.phase.step) < 3:
            return "pause"
        return "stop" if shown.phase.step == self._stops else None


def test_a_plugin_pauses_and_stops_a_run_between_two_steps_without_changing_it(scene, tmp_path):
    build, between = assemble.make_manager, Between(3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            assemble, "make_manager", lambda plugins: build({**plugins, "between": between})
        )
        assert run(scene, tmp_path / "stopped", steps=6) == 0
    assert between._calls == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert run(scene, tmp_path / "other", steps=6, stop_after=3) == 0
    first, second = (load(latest(tmp_path / name)) for name in ("stopped", "other"))
    assert first.step == second.step == 3
    assert all(first.parameters[n].equal(second.parameters[n]) for n in second.parameters)
