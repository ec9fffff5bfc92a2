"""Runs that begin with small photos: resumed, within seconds, and beside what looks at renders."""

import json
from dataclasses import replace

import pytest
import torch
from support.pace import each_step_takes
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.plugin import Observer, Schedule, hookimpl
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run import app
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.results.config_file import read_config
from crossgrad_core.run.results.metrics_csv import read_metrics
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.probe_gradients import view_gradients
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import model_of
from crossgrad_plugins.resolutions.octaves import Octaves

SPECTRAL = {"name": "spectral", "smallest": 4, "per_regime": "always"}
OCTAVES = {"name": "octaves", "smallest": 4}
STRIDED = {"name": "strided", "smallest": 4, "least": 16}
GROWTH = {"schedule_unit": "steps", "densify_from": 4, "densify_until": 18, "densify_every": 6}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=5, folders=("near", "far"))


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": 24, "eval_every": 12, "threads": 1}
    return app.run({**given, **GROWTH, **settings}, verbosity=-1)


def all_of(out):
    """All by which two runs may differ but clocks."""
    found = load(latest(out))
    states = {name: (s.values, s.tensors, s.per_primitive) for name, s in found.plugins.items()}
    last = {name: value for name, value in found.scalars["last"].items() if "seconds" not in name}
    return {**found.parameters, **found.exp_avg}, (last, found.generators), states


def same(one, other):
    (tensors, plain, states), (tensors_b, plain_b, states_b) = all_of(one), all_of(other)
    assert tensors.keys() == tensors_b.keys() and plain == plain_b
    assert all(torch.equal(tensors[name], tensors_b[name]) for name in tensors)
    assert states.keys() == states_b.keys()
    for name, (values, *kept) in states.items():
        assert values == states_b[name][0]
        for mine, theirs in zip(kept, states_b[name][1:], strict=True):
            assert all(torch.equal(mine[key], theirs[key]) for key in mine)


def notes(out):
    return [
        note
        for note in json.loads((out / "summary.json").read_text())["notes"]
        if note.startswith("resolution")
    ]


#: The length grows while scales do, and shrinks again.
REVISIONS = {"revisions": [[3, 60], [11, 30]]}
CASES = {
    "spectral": {"resolution": SPECTRAL},
    "strided, a length that changes": {"resolution": STRIDED, **REVISIONS},
    "octaves, a length that changes": {"resolution": OCTAVES, **REVISIONS},
    "spectral, a length that changes": {"resolution": SPECTRAL, **REVISIONS},
    "running losses, exposure, average": {
        "resolution": SPECTRAL, "sampler": {"name": "active"}, "operator": {"name": "gradnorm"},
        "exposure": {"name": "gain"}, "rules": {"weight-averaging": {"share": 0.3}},
    },
    "a further view, anchors": {
        "resolution": SPECTRAL, "backbone": {"name": "scaffold"}, "densify_views": "extra",
        "views": 3,
    },
    "weights of pixels in both sizes": {
        "resolution": OCTAVES, "densifier": {"name": "pixel"}, "views": "1..2@0.5",
    },
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_resumed_run_ends_with_the_bits_of_an_uninterrupted_run(scene, tmp_path, case):
    assert run(scene, tmp_path / "whole", **CASES[case]) == 0
    assert run(scene, tmp_path / "parts", stop_after=7, **CASES[case]) == 0
    assert load(latest(tmp_path / "parts")).scalars["last"]["scales"][0] < 1.0
    assert app.run({}, resume=tmp_path / "parts", verbosity=-1) == 0
    same(tmp_path / "whole", tmp_path / "parts")
    assert notes(tmp_path / "whole") == notes(tmp_path / "parts") != []


@pytest.mark.slow
@pytest.mark.parametrize("resolution", [OCTAVES, SPECTRAL])
def test_the_configuration_of_a_run_with_a_time_budget_repeats_it_bit_for_bit(
    scene, tmp_path, monkeypatch, resolution
):
    # Whatever the probe of this machine says, the first plan is wrong: the run gets longer.
    monkeypatch.setattr(app, "steps_for", lambda setup, seconds: (16, "few steps", 0.0))
    each_step_takes(monkeypatch, 0.025)
    settings = {"steps": None, "seconds": 1.0, "resolution": resolution}
    assert run(scene, tmp_path / "timed", **settings) == 0
    stored = read_config(tmp_path / "timed")
    last = load(latest(tmp_path / "timed"))
    assert last.step == stored["revisions"][-1][1] > 2 * 16
    assert set(last.scalars["last"]["scales"]) == {1.0}
    monkeypatch.undo()
    assert app.run({**stored, "out": str(tmp_path / "again")}, verbosity=-1) == 0
    same(tmp_path / "timed", tmp_path / "again")
    # Of the notes on scales there is one, and it is that of the length in the end.
    (note,) = notes(tmp_path / "timed")
    if resolution is OCTAVES:
        (expected,) = Octaves(smallest=4).messages(Schedule.for_run(last.step))
        assert note == expected
    else:
        assert "far 1/" in note and "near 1/" in note and note.count("full size from step 19") == 2


def test_metrics_are_measured_at_full_size(scene, tmp_path):
    settings = {"steps": 1, "rate_factor": 1e-9, "eval_every": 1}
    run(scene, tmp_path / "full", **settings)
    run(scene, tmp_path / "small", **settings, resolution=OCTAVES)
    assert load(latest(tmp_path / "small")).scalars["last"]["scales"] == [0.25]
    full, small = (read_metrics(tmp_path / name)[-1] for name in ("full", "small"))
    assert small["psnr"] == pytest.approx(full["psnr"], abs=1e-5)
    assert small["ssim"] == pytest.approx(full["ssim"], abs=1e-6)


def assembled(**settings):
    config = RunConfig.model_validate({"steps": 60, **GROWTH, **settings})
    return assemble(config, sample_scene(), "none")


class Records(Observer):
    """Keeps the scales and sizes that density control sees."""

    seen: list

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        self.seen.append([(r.view.regime, r.scale, tuple(r.image.shape)) for r in context.views])
        return (yield)


def watched(setup):
    records = Records(seen=[])
    plugins = {**setup.plugins, "records": records}
    return replace(setup, manager=make_manager(plugins), plugins=plugins), records.seen


PARTS = {"far": {"photos": 4, "scales": [0.25]}, "near": {"photos": 5, "scales": [0.5]}}


@pytest.mark.parametrize("views", [1, 2])
def test_an_extra_view_has_the_render_scale_of_its_regime_and_changes_no_other_view(views):
    asked = {"resolution": {"name": "spectral", "smallest": 1, "courses": PARTS}, "views": views}
    scales = {"far": 0.25, "near": 0.5}
    streams = []
    for densify_views in ("all", "extra"):
        setup, seen = watched(assembled(**asked, densify_views=densify_views))
        state = first_state(setup)
        reached = []
        for _ in range(12):
            timed_step(setup, state)
            reached.append(state.states["resolution"].values)
        assert {len(step) for step in seen} == {views + (densify_views == "extra")}
        for step in seen:
            for regime, scale, shape in step:
                assert scale == scales[regime]
                assert shape == (round(16 * scale), round(24 * scale), 3)
        streams.append((state.rngs["resolution"].bit_generator.state, seen, reached))
    # The regimes of the step's own views are as they were without the further one.
    assert streams[0][0] == streams[1][0]
    assert [step[:views] for step in streams[1][1]] == streams[0][1]
    assert streams[0][2] == streams[1][2]


def test_renders_between_steps_have_the_full_size():
    setup = assembled(resolution=OCTAVES, views=1)
    state = first_state(setup)
    record = timed_step(setup, state)
    assert record.scales == (0.25,)
    model = model_of(setup, state)
    drawn = model.render(0)
    assert drawn.image.shape == (16, 24, 3) == drawn.photo.shape
    found = view_gradients(model, setup.train_views[0], ["means"])
    full = assembled(views=1)
    other = view_gradients(
        model_of(full, replace(state, states={})), full.train_views[0], ["means"]
    )
    assert torch.equal(found["means"], other["means"])
