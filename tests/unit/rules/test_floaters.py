"""Primitives before cameras that no training photo shows are removed at the end of a run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.fixtures import posed_scene, posed_view, sample_scene
from crossgrad_core.training.rules import eval_parameters
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import final_edits, model_of, take_step
from crossgrad_plugins.rules import floaters as rule
from crossgrad_plugins.rules.floaters import FEWEST_SEEN, Floaters, removed

EMPTY = Floaters().empty
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


def cleaned(setup, state):
    """How many floaters were removed from the state."""
    before = state.primitives(setup)
    notes = [edit.note for edit in final_edits(setup, state)]
    gone = before - state.primitives(setup)
    assert notes == ([removed(gone)] if gone else [])
    return gone


def shown(setup, state):
    """The model as it is shown at the end of a run."""
    phase, parameters = setup.phase(state.step, training=False), eval_parameters(setup, state)
    return replace(model_of(setup, state), phase=phase, parameters=parameters)


def floaters(setup, state):
    return rule.floaters(shown(setup, state), EMPTY)


def in_empty_space(places, scene):
    return rule.in_empty_space(places, scene, EMPTY)


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
        nearest = np.percentile(camera.local(setup.scene.points)[:, 2], 1)
        if min(ways) < EMPTY * nearest and not touched[row]:
            found.append(row)
    return found


@pytest.mark.sampled(3)
@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("seed", range(3))
def test_floaters_are_the_primitives_near_a_camera_that_no_training_photo_shows(backbone, seed):
    setup = setup_of(backbone)
    state = scattered(setup, seed)
    want = expected(setup, state)
    assert floaters(setup, state).tolist() == want
    near = in_empty_space(
        state.parameters[setup.backbone.positions].detach().double().numpy(), setup.scene
    )
    # There are floaters, and others before cameras that are not: both rules decide something.
    assert 0 < len(want) < near.sum() < len(near)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("backbone", BACKBONES)
def test_removing_floaters_does_not_change_the_renders_of_photos(backbone):
    setup = setup_of(backbone)
    state = scattered(setup)
    before = [render.image for _, render in images(setup, state.parameters)]
    primitives, gone = state.primitives(setup), floaters(setup, state)
    kept = np.setdiff1d(np.arange(primitives), gone.numpy())
    tensors = {name: t.detach().clone() for name, t in state.parameters.items()}
    assert cleaned(setup, state) == len(gone) > 0
    for block in setup.blocks:
        if block.per_primitive:
            for name in block.tensors:
                assert torch.equal(state.parameters[name].detach(), tensors[name][kept]), name
    after = [render.image for _, render in images(setup, state.parameters)]
    # Networks multiply as many rows as there are, and may round accordingly.
    close = {"rtol": 0.0, "atol": 1e-5 if backbone in {"octree", "scaffold"} else 0.0}
    for one, two in zip(before, after, strict=True):
        torch.testing.assert_close(two, one, **close)
    assert cleaned(setup, state) == 0
    assert state.primitives(setup) == primitives - len(gone)


def test_removing_floaters_reduces_moments_states_and_the_average_together():
    setup = setup_of(rules={"weight-averaging": {"share": 1.0}})
    state = scattered(setup)
    for _ in range(3):
        take_step(setup, state)
    rows = torch.arange(state.primitives(setup))
    state.commit({"other": PluginState(per_primitive={"rows": rows})})
    gone = floaters(setup, state)
    kept = np.setdiff1d(np.arange(state.primitives(setup)), gone.numpy())
    wanted = {name: t.detach()[kept] for name, t in eval_parameters(setup, state).items()}
    moments = {name: t[kept] for name, t in state.adam.exp_avg_sq.items()}
    assert cleaned(setup, state) == len(gone) > 0
    assert state.states["weight-averaging"].values == {"count": 3}
    assert state.states["other"].per_primitive["rows"].tolist() == kept.tolist()
    assert all(
        torch.equal(eval_parameters(setup, state)[name].detach(), t) for name, t in wanted.items()
    )
    assert all(torch.equal(state.adam.exp_avg_sq[name], t) for name, t in moments.items())
    take_step(setup, state)


def test_floaters_are_searched_in_the_averaged_parameters():
    setup = setup_of(rules={"weight-averaging": {"share": 1.0}})
    state = scattered(setup)
    take_step(setup, state)
    gone = floaters(setup, state)
    assert len(gone) > 0
    # The parameters go back among what all cameras see, the average stays behind.
    state.parameters["means"].detach()[:] = 0.0
    assert torch.equal(floaters(setup, state), gone)


def test_a_failed_removal_of_floaters_does_not_change_the_state():
    setup = setup_of()
    state = scattered(setup)
    take_step(setup, state)
    state.commit({"wrong": PluginState(per_primitive={"rows": torch.zeros(3)})})
    tensors, moments, before = state.tensors, state.moments, state.primitives(setup)
    with pytest.raises(UserError, match="state of plugin wrong does not match"):
        cleaned(setup, state)
    assert state.tensors is tensors and state.moments is moments
    assert {len(t) for t in moments.exp_avg.values()} == {before}


def test_no_primitive_is_removed_if_all_are_floaters():
    setup = setup_of(initializer=ComponentChoice(name="points"))
    state = first_state(setup)
    behind = setup.train_views[0].camera
    positions = state.parameters["means"].detach()
    # Behind this camera, and beyond what the others see of that place.
    positions[:] = (behind.center + 0.2 * behind.center / behind.center.norm()).float()
    assert len(floaters(setup, state)) == len(positions)
    assert Floaters().crossgrad_final_edit(shown(setup, state)) is None


def looking(name, points, seen=None, forward=(0, 1, 0)):
    rows = range(len(points)) if seen is None else seen
    return posed_view((0, 0, 0), name, forward=forward, seen=rows)


def test_the_empty_space_of_a_camera_is_a_share_of_the_distance_to_its_nearest_point():
    points = [(0.1 * x, 2.0 + 0.01 * x, 0.0) for x in range(FEWEST_SEEN)]
    scene = posed_scene([looking("one.png", points)], points)
    near, far = 1.99 * EMPTY, 2.01 * EMPTY
    places = np.array([(0, near, 0), (0, far, 0), (near, 0, 0), (0, -near, 0), (0, 0, far)])
    assert in_empty_space(places, scene).tolist() == [True, False, True, True, False]
    few = posed_scene([looking("one.png", points, range(FEWEST_SEEN - 1))], points)
    assert not in_empty_space(places, few).any()


def test_outlier_points_and_points_of_other_photos_do_not_shrink_the_empty_space():
    points = [(0.01 * x, 2.0, 0.0) for x in range(200)]
    points[7] = (0.0, 0.1, 0.0)  # Half a percent.
    others = [(0.0, 0.2, 0.1 * x) for x in range(50)]
    one = looking("one.png", points)
    scene = posed_scene([one], [*points, *others])
    places = np.array([(0, 1.9 * EMPTY, 0), (0, 2.1 * EMPTY, 0)])
    assert in_empty_space(places, scene).tolist() == [True, False]
    backwards = posed_scene([looking("one.png", points, forward=(0, -1, 0))], points)
    assert not in_empty_space(places, backwards).any()


def test_ground_below_a_level_camera_is_not_in_empty_space():
    # 1.6 high, with a vertical field of view of 50 degrees, it sees the ground from 3.4 on.
    ground = [(x, 1.6 / np.tan(np.radians(25.0)) + y, -1.6) for x in (-1, 0, 1) for y in range(30)]
    scene = posed_scene([looking("level.png", ground)], ground)
    assert in_empty_space(np.array([(0.0, 0.0, -1.6), (0.0, 0.0, -0.9)]), scene).tolist() == [
        False,
        True,
    ]


def test_no_floaters_are_found_without_observations():
    scene = sample_scene()
    blind = replace(
        scene, views=tuple(replace(view, seen=np.zeros(0, np.int64)) for view in scene.views)
    )
    setup = setup_of(scene=blind)
    assert len(floaters(setup, scattered(setup))) == 0
    with pytest.raises(UserError, match="no photo observes enough points"):
        refuse_settings_for_nothing(
            setup.config.model_copy(update={"rules": {"floaters": {}}}), setup
        )


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({}, True),
        ({"recipe": {"name": "published"}}, False),
        ({"densifier": ComponentChoice(name="none")}, False),
        ({"recipe": {"name": "published"}, "rules": {"floaters": True}}, True),
        ({"rules": {"floaters": False}}, False),
        ({"densifier": ComponentChoice(name="none"), "rules": {"floaters": {}}}, True),
    ],
)
def test_the_floaters_rule_is_selected_by_default(given, what):
    assert bool(resolved(setup_of(**given)).rules.get("floaters")) == what


def test_only_densifier_none_disables_the_removal_of_floaters():
    never = {n for n in entries("densifiers") if not build(Densifier, n, {}).edits}
    assert never == {"none"}
    said = (Path(__file__).parents[3] / "docs" / "rules.md").read_text(encoding="utf-8")
    row = next(line for line in said.splitlines() if line.startswith("| `rules.floaters`"))
    assert "none" in row


def test_the_message_about_floaters_uses_singular_and_plural():
    assert removed(1).startswith("floaters: 1 primitive was removed")
    assert removed(1200).startswith("floaters: 1,200 primitives were removed")
