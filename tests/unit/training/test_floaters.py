"""Primitives before cameras that no training photo shows are removed at the end of a run."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.migration import migrated
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.posed import posed_scene, posed_view
from crossgrad_core.training.floaters import (
    EMPTY,
    FEWEST_SEEN,
    floaters,
    in_empty_space,
    remove_floaters,
    told_of,
)
from crossgrad_core.training.start import first_state
from crossgrad_core.training.steady import STATE, shown
from crossgrad_core.training.step import take_step

BACKBONES = sorted(n for n, e in entries("backbones").items() if e.distribution == "crossgrad")
#: On a scene of forty points the published cells of anchors would hold nothing.
OPTIONS = {"scaffold": {"voxel_size": 1e-5}}


def setup_of(backbone="vanilla", scene=None, **settings):
    choice = ComponentChoice.model_validate({"name": backbone, **OPTIONS.get(backbone, {})})
    given = {"steps": 10, "backbone": choice, **settings}
    return assemble(RunConfig(**given), scene or sample_scene(), "none")


def scattered(setup, seed=0, share=0.7):
    """The first state, with a share of the primitives anywhere between and behind the cameras."""
    state, rng = first_state(setup), np.random.default_rng(seed)
    positions = state.parameters[setup.backbone.positions].detach()
    rows = np.flatnonzero(rng.random(len(positions)) < share)
    cameras = setup.scene.train_views
    centers = np.stack([cameras[each].camera.center.numpy() for each in rows % len(cameras)])
    moved = centers + 0.15 * rng.standard_normal((len(rows), 3))
    positions[torch.from_numpy(rows)] = torch.from_numpy(moved).float()
    return state


def images(setup, parameters, step=0):
    phase = setup.phase(step, training=False)
    with torch.no_grad():
        for view in setup.train_views:
            gaussians = setup.backbone.decode(parameters, view.camera, phase)
            yield gaussians, setup.rasterizer.render(gaussians, view.camera, torch.zeros(3))


def expected(setup, state):
    """The floaters by the whole model's renders and all distances, one by one."""
    positions = state.parameters[setup.backbone.positions].detach().double().numpy()
    touched, found = np.zeros(len(positions), dtype=bool), []
    for gaussians, render in images(setup, state.parameters):
        rows = torch.arange(len(gaussians)) if gaussians.origin is None else gaussians.origin
        touched[rows[render.screen.radii > 0].numpy()] = True
    for row, position in enumerate(positions):
        ways = [np.linalg.norm(v.camera.center.numpy() - position) for v in setup.train_views]
        camera = setup.train_views[int(np.argmin(ways))].camera
        nearest = np.percentile(camera.local(setup.scene.points)[:, 2], 1.0)
        if min(ways) < EMPTY * nearest and not touched[row]:
            found.append(row)
    return found


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("seed", range(3))
def test_what_floats_is_what_the_whole_models_photos_leave_out(backbone, seed):
    setup = setup_of(backbone)
    state = scattered(setup, seed)
    want = expected(setup, state)
    assert floaters(setup, state).tolist() == want
    near = in_empty_space(
        state.parameters[setup.backbone.positions].detach().double().numpy(), setup.scene
    )
    # There are floaters, and others before cameras that are not: both rules decide something.
    assert 0 < len(want) < near.sum() < len(near)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_photos_stay_as_they_are(backbone):
    setup = setup_of(backbone)
    state = scattered(setup)
    before = [render.image for _, render in images(setup, state.parameters)]
    primitives, gone = state.primitives(setup), floaters(setup, state)
    kept = np.setdiff1d(np.arange(primitives), gone.numpy())
    tensors = {name: t.detach().clone() for name, t in state.parameters.items()}
    assert remove_floaters(setup, state) == len(gone) > 0
    for block in setup.blocks:
        if block.per_primitive:
            for name in block.tensors:
                assert torch.equal(state.parameters[name].detach(), tensors[name][kept]), name
    after = [render.image for _, render in images(setup, state.parameters)]
    assert all(torch.equal(one, two) for one, two in zip(before, after, strict=True))
    assert remove_floaters(setup, state) == 0
    assert state.primitives(setup) == primitives - len(gone)


def test_moments_states_and_the_average_come_along():
    setup = setup_of(average=1.0)
    state = scattered(setup)
    for _ in range(3):
        take_step(setup, state)
    gone = floaters(setup, state)
    kept = np.setdiff1d(np.arange(state.primitives(setup)), gone.numpy())
    wanted = {name: t.detach()[kept] for name, t in shown(state).items()}
    moments = {name: t[kept] for name, t in state.adam.exp_avg_sq.items()}
    seconds = state.clock.train
    assert remove_floaters(setup, state) == len(gone) > 0
    assert state.states[STATE].values == {"count": 3}
    assert all(torch.equal(shown(state)[name].detach(), t) for name, t in wanted.items())
    assert all(torch.equal(state.adam.exp_avg_sq[name], t) for name, t in moments.items())
    assert state.clock.train > seconds
    take_step(setup, state)


def test_a_set_of_which_nothing_would_be_left_stays():
    setup = setup_of()
    state = first_state(setup)
    behind = setup.train_views[0].camera
    positions = state.parameters["means"].detach()
    # Behind this camera, and beyond what the others see of that place.
    positions[:] = (behind.center + 0.3 * behind.center / behind.center.norm()).float()
    everything = len(floaters(setup, state)) == len(positions)
    assert everything and remove_floaters(setup, state) == 0
    assert state.primitives(setup) == len(positions)


def test_the_empty_space_ends_half_way_to_the_nearest_point():
    points = [(0.1 * x, 2.0 + 0.01 * x, 0.0) for x in range(FEWEST_SEEN)]
    seen = range(FEWEST_SEEN)
    one = posed_view((0, 0, 0), "one.png", forward=(0, 1, 0), seen=seen)
    scene = posed_scene([one, replace(one, name="two.png", seen=np.arange(1))], points)
    places = np.array([(0, 0.99, 0), (0, 1.01, 0), (0.99, 0, 0), (0, -0.99, 0), (0, 0, 1.01)])
    assert in_empty_space(places, scene).tolist() == [True, False, True, True, False]
    few = posed_scene([replace(one, seen=np.arange(FEWEST_SEEN - 1))], points)
    assert not in_empty_space(places, few).any()


def test_nothing_floats_where_nothing_says_what_is_empty():
    scene = sample_scene()
    blind = replace(
        scene, views=tuple(replace(view, seen=np.zeros(0, np.int64)) for view in scene.views)
    )
    setup = setup_of(scene=blind)
    assert len(floaters(setup, scattered(setup))) == 0


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({}, "remove"),
        ({"preset": "inria"}, "keep"),
        ({"densifier": ComponentChoice(name="none")}, "keep"),
        ({"preset": "inria", "floaters": "remove"}, "remove"),
        ({"floaters": "keep"}, "keep"),
        ({"densifier": ComponentChoice(name="none"), "floaters": "remove"}, "remove"),
    ],
)
def test_the_default_and_what_is_said_of_it(given, what):
    assert resolved(setup_of(**given)).floaters == what


def test_only_none_keeps_its_set():
    never = {n for n in entries("densifiers") if not build(Densifier, n, {}).edits}
    assert never == {"none"}
    assert "where density control is none" in RunConfig.model_fields["floaters"].description


def test_runs_of_before_go_on_without(tmp_path):
    assert migrated({"revisions": []}, tmp_path)["floaters"] == "keep"
    assert "floaters" not in migrated({}, tmp_path)


def test_one_and_many_in_words():
    assert told_of(1).startswith("floaters: 1 primitive was removed")
    assert told_of(1200).startswith("floaters: 1,200 primitives were removed")
