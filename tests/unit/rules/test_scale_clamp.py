"""No Gaussian is longer than its share of the distance to cameras that have it at their side."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.commands import ended

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import apply_edit, take_step
from crossgrad_plugins.recipes.auto import SCALE_RATIO as BOUND
from crossgrad_plugins.rules import scale_clamp
from crossgrad_plugins.rules.scale_clamp import EVERY, LEAST

ANCHORS = ("octree", "scaffold")
AXES = sorted(
    name
    for name, entry in entries("backbones").items()
    if entry.distribution == "crossgrad" and name not in ANCHORS
)
OPTIONS = {"scaffold": {"voxel_size": 1e-5}}


def setup_of(backbone="vanilla", **settings):
    options = settings.pop("options", OPTIONS.get(backbone, {}))
    choice = ComponentChoice.model_validate({"name": backbone, **options})
    return assemble(
        RunConfig(**{"steps": 100, "backbone": choice, **settings}), sample_scene(), "none"
    )


def using(ratio):
    """The setting of a run with a bound; None leaves it to the recipe."""
    return {} if ratio is None else {"scale-clamp": {"ratio": ratio} if ratio else False}


def clamp_scales(setup, state):
    context = SimpleNamespace(
        step=state.step, scene=setup.scene, backbone=setup.backbone, parameters=state.parameters
    )
    answer = setup.selection.rules["scale-clamp"].crossgrad_after_optimizer(context)
    if answer is not None:
        apply_edit(setup, state, answer.edit)


def at_random(setup, seed, step=EVERY):
    """A state whose Gaussians have positions and sizes of many orders around the cameras."""
    rng = np.random.default_rng(seed)
    state = first_state(setup)
    state.step = step
    centers = setup.scene.centers
    count = len(state.parameters["means"])
    offsets = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-5, 2, (count, 1))
    means = centers[rng.integers(len(centers), size=count)] + offsets
    means[0] = centers[0].astype(np.float32)
    scales = rng.uniform(-8, 5, (count, 3))
    for name, values in (("means", means), ("scales", scales)):
        state.parameters[name].detach().copy_(torch.from_numpy(values))
    return state


def shows(camera, position):
    """Whether a position lies in the photo of a camera."""
    ((x, y),), (depth,) = camera.project(position[None])
    return depth > 0 and 0 <= x <= camera.width and 0 <= y <= camera.height


def expected(setup, state, bound):
    """One Gaussian after the other, in float64."""
    means = state.parameters["means"].detach().double().numpy()
    scales = state.parameters["scales"].detach().double().numpy()
    wanted = scales.copy()
    for i, mean in enumerate(means):
        beside = [view.camera for view in setup.scene.train_views if not shows(view.camera, mean)]
        distance = min((np.linalg.norm(mean - c.center.numpy()) for c in beside), default=np.inf)
        if np.exp(scales[i].max()) > LEAST:
            wanted[i] = np.minimum(scales[i], np.log(max(bound * distance, LEAST)))
    return wanted


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("seed", "bound", "at_once"),
    [(0, None, 1), (1, None, 2**20), (2, 0.2, 1), (3, 0.2, 2**20), (4, 3.0, 1), (5, 3.0, 2**20)],
)
def test_axes_of_gaussians_are_clamped_to_the_allowed_length(seed, bound, at_once, monkeypatch):
    monkeypatch.setattr(scale_clamp, "_AT_ONCE", at_once)
    setup = setup_of(rules=using(bound))
    state = at_random(setup, seed)
    before = {name: each.detach().clone() for name, each in state.parameters.items()}
    wanted = expected(setup, state, bound or BOUND)
    clamp_scales(setup, state)
    after = state.parameters["scales"].detach()
    # The one that stands in a camera, to rounding, may lie in its photo or not.
    assert np.abs(after.numpy() - wanted)[1:].max() < 2e-6
    changed = (after != before["scales"]).any(dim=1)
    assert 0 < int(changed.sum()) < len(changed)
    assert (after <= before["scales"]).all()
    assert all(torch.equal(state.parameters[n], before[n]) for n in before if n != "scales")


def test_non_finite_and_small_scales_are_not_clamped():
    setup = setup_of()
    state = at_random(setup, 0)
    scales = state.parameters["scales"].detach()
    state.parameters["means"].detach()[:4] = torch.from_numpy(setup.scene.centers[0])
    scales[:4] = torch.tensor([np.inf, np.nan, np.log(LEAST) - 1e-3, np.log(LEAST) + 1e-3])[:, None]
    before = scales[:3].clone()
    clamp_scales(setup, state)
    scales = state.parameters["scales"].detach()
    assert torch.equal(scales[:3].nan_to_num(nan=-99.0), before.nan_to_num(nan=-99.0))
    assert scales[3, 0] >= np.log(np.float32(LEAST)) - 1e-6


def test_scales_below_the_bound_are_not_clamped():
    """Either no Gaussian is large, or all Gaussians are large and far away."""
    setup = setup_of()
    state = at_random(setup, 0)
    scales = state.parameters["scales"].detach()
    for size in (-9.0, 9.0):
        state.parameters["means"].detach()[:] = 1e4  # 17,321 away; the larger size is 8,103.
        scales[:] = size
        clamp_scales(setup, state)
        scales = state.parameters["scales"].detach()
        assert torch.equal(scales, torch.full_like(scales, size))


@pytest.mark.slow
def test_a_run_in_seconds_reports_the_rule_after_its_length_is_planned(tmp_path, capsys):
    command = ("run", "--seconds", 1, "--max-size", 48, "--threads", 1, "--out", tmp_path / "run")
    assert ended(*command) == 0
    assert (
        "--no-rule scale-clamp" in capsys.readouterr().out + (tmp_path / "run/log.txt").read_text()
    )


def test_scales_are_clamped_at_fixed_intervals_only():
    setup = setup_of()
    state = at_random(setup, 0, step=EVERY + 1)
    before = state.parameters["scales"].detach().clone()
    clamp_scales(setup, state)
    assert torch.equal(state.parameters["scales"], before)


@pytest.mark.parametrize("backbone", AXES)
def test_a_step_clamps_only_scales_above_the_bound(backbone):
    """The moments of Adam do not change. Other values have the bits of a step without a bound."""
    found = {}
    for bound in (None, 0.0):
        setup = setup_of(backbone, rules=using(bound), initializer={"name": "points"})
        state = first_state(setup)
        state.step = EVERY - 1
        # Behind all cameras that are in front of the scene, and long.
        state.parameters["means"].detach()[3] = 1.5 * torch.from_numpy(setup.scene.centers[0])
        state.parameters["scales"].detach()[3, 1] = 5.0
        take_step(setup, state)
        assert state.step == EVERY
        found[bound] = state.parameters["scales"].detach(), state.moments.exp_avg["scales"]
    bounded, free = found[None][0], found[0.0][0]
    assert torch.equal(found[None][1], found[0.0][1])
    assert bounded[3, 1] < 3.0 < free[3, 1]
    assert [tuple(each) for each in (bounded != free).nonzero().tolist()] == [(3, 1)]


@pytest.mark.parametrize(
    ("settings", "bound"),
    [
        ({}, BOUND),
        ({"steps": 29_999}, BOUND),
        ({"steps": None, "seconds": 5.0}, BOUND),
        ({"steps": 30_000}, 0.0),
        ({"steps": 30_000, "rules": using(0.7)}, 0.7),
        ({"rules": using(0.0)}, 0.0),
        ({"recipe": {"name": "published"}}, 0.0),
        ({"schedule": "absolute"}, 0.0),
        ({"options": {"lr_scales": 0.0}}, 0.0),
        *(({"backbone": name}, 0.0) for name in ANCHORS),
    ],
    ids=str,
)
def test_the_scale_clamp_rule_is_selected_by_default(settings, bound):
    setup = setup_of(**settings)
    rule = setup.selection.rules.get("scale-clamp")
    assert (0.0 if rule is None else rule.ratio) == bound
    told = [row for row in setup.decisions if row.override == "--no-rule scale-clamp"]
    assert len(told) == (bound == BOUND)


@pytest.mark.parametrize(
    "settings", [{"options": {"lr_scales": 0.0}}, *({"backbone": name} for name in ANCHORS)]
)
def test_the_scale_clamp_rule_is_refused_for_a_backbone_without_trained_scales(settings):
    setup = setup_of(**settings)
    config = setup.config.model_copy(update={"rules": using(0.5)})
    with pytest.raises(UserError, match="trains no Gaussians with axes"):
        refuse_settings_for_nothing(config, setup)
