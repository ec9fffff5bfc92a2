"""Positions step along the axes of their Gaussians, by shares of their lengths."""

from dataclasses import replace
from math import log

import numba
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from typing_extensions import override

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import Checkpoint
from crossgrad_core.run.load_run import check_settings, settings_of
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.adam.axes import LIMIT, _usual, step_along_axes
from crossgrad_core.training.rates import axes_of
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import take_step

BACKBONES = sorted(n for n, e in entries("backbones").items() if e.distribution == "crossgrad")
ANCHORS = {"octree", "scaffold"}
OPTIONS = {"scaffold": {"voxel_size": 1e-5}}


def gaussians(count, seed, spread=1.5):
    """Positions, steps, logarithms of lengths and rotations of any length, float32."""
    rng = np.random.default_rng(seed)
    arrays = [
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-8, 0, (count, 1)),
        rng.normal(-5.0, spread, (count, 3)),
        rng.normal(size=(count, 4)) * 10.0 ** rng.uniform(-6, 6, (count, 1)),
    ]
    return [torch.from_numpy(each).float() for each in arrays]


def expected(positions, steps, scales, quats):
    """One Gaussian after the other, in float64, rotations by scipy."""
    given = (positions, steps, scales, quats)
    positions, steps, scales, quats = (each.double().numpy() for each in given)
    rows = scales[:: -(-len(scales) // 1024)]
    # torch's median of an even number is the lower one.
    usual = np.sort(np.sort(rows, axis=1)[:, 1])[(len(rows) - 1) // 2]
    factors = np.exp(np.clip(scales - usual, -log(LIMIT), log(LIMIT)))
    moved = np.empty_like(positions)
    for i, (w, x, y, z) in enumerate(quats):
        turn = Rotation.from_quat([x, y, z, w]).as_matrix() if quats[i].any() else np.eye(3)
        moved[i] = positions[i] + turn @ (factors[i] * (turn.T @ steps[i]))
    return moved


@pytest.mark.parametrize("count", [1, 2, 7, 1500])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_adam_steps_are_stretched_along_the_axes_of_their_gaussian(count, kind):
    positions, steps, scales, quats = gaussians(count, count)
    quats[count // 2] = 0.0
    want = expected(positions, steps, scales, quats)
    given = [each.to(kind) for each in (steps, scales, quats)]
    found = positions.to(kind)
    step_along_axes(found, *given)
    # Products and sums of numbers that are not larger than LIMIT times the step.
    reach = LIMIT * steps.abs().amax(dim=1, keepdim=True).double().numpy()
    bound = 32 * torch.finfo(kind).eps * (np.abs(want) + reach)
    assert (np.abs(found.double().numpy() - want) <= bound).all()


def test_equal_round_gaussians_take_the_plain_steps_of_adam():
    positions, steps, _, quats = gaussians(100, 3)
    found = positions.clone()
    step_along_axes(found, steps, torch.full((100, 3), -4.0), quats)
    assert torch.allclose(found, positions + steps, rtol=1e-6, atol=1e-7)


def test_the_step_factor_along_one_axis_of_a_gaussian_is_limited():
    scales = torch.tensor([[-50.0, 0.0, 50.0]] + [[0.0, 0.0, 0.0]] * 4)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(5, 1)
    found = torch.zeros(5, 3)
    step_along_axes(found, torch.ones(5, 3), scales, quats)
    assert torch.allclose(found[0], torch.tensor([1 / LIMIT, 1.0, LIMIT]))
    assert torch.equal(found[1:], torch.ones(4, 3))


def test_steps_of_an_empty_model_work():
    step_along_axes(*(torch.zeros(0, columns) for columns in (3, 3, 3, 4)))


def test_a_rotated_scene_takes_rotated_steps():
    _, steps, scales, quats = gaussians(50, 5)
    quats = torch.nn.functional.normalize(quats)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    matrix = torch.from_numpy(turn.as_matrix()).float()
    own = Rotation.from_quat(quats[:, [1, 2, 3, 0]].numpy())
    turned_quats = torch.from_numpy((turn * own).as_quat()[:, [3, 0, 1, 2]]).float()
    found, turned = torch.zeros(50, 3), torch.zeros(50, 3)
    step_along_axes(found, steps, scales, quats)
    step_along_axes(turned, steps @ matrix.T, scales, turned_quats)
    assert torch.allclose(turned, found @ matrix.T, rtol=1e-4, atol=1e-6 * float(found.abs().max()))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS == 1, reason="there is one thread")
def test_the_number_of_threads_changes_no_bit(keeps_threads):
    found = []
    for threads in (1, 2):
        configure_threads(threads)
        arrays = gaussians(40_000, 9)
        step_along_axes(*arrays)
        found.append(arrays[0])
    assert torch.equal(*found)


def test_a_non_finite_gaussian_does_not_affect_other_gaussians():
    positions, steps, scales, quats = gaussians(9, 2)
    want = positions.clone()
    step_along_axes(want, steps, scales, quats)
    for odd in (float("nan"), float("inf"), -float("inf")):
        found, broken = positions.clone(), scales.clone()
        broken[4] = odd
        step_along_axes(found, steps, broken, quats)
        # The median of eight and that of nine differ; all others are moved by it alike.
        assert found[[*range(4), *range(5, 9)]].isfinite().all()


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(20))
def test_the_typical_size_is_the_median_of_the_finite_middle_axes_of_gaussians(seed, kind):
    """In the order of axes, NaN counts as the longest length."""
    rng = np.random.default_rng(seed)
    scales = rng.normal(size=(rng.integers(1, 40), 3))
    odd = rng.random(scales.shape) < rng.choice([0.1, 0.6])
    scales[odd] = rng.choice([np.nan, np.inf, -np.inf], odd.sum())
    middle = np.sort(scales, axis=1)[:, 1]
    middle = np.sort(middle[np.isfinite(middle)])
    found = float(_usual(torch.from_numpy(scales).to(kind)))
    want = middle[(len(middle) - 1) // 2] if len(middle) else np.nan
    assert found == pytest.approx(want, rel=1e-6, nan_ok=True)


def test_a_zero_quaternion_means_no_rotation():
    steps = torch.tensor([[1.0, 2.0, 3.0]]).repeat(3, 1)
    quats = torch.tensor([[1e-20, 2e-20, 0.0, 1e-20], [1e-23, 0.0, 1e-23, 0.0], [0.0] * 4])
    found = torch.zeros(3, 3)
    step_along_axes(found, steps, torch.zeros(3, 3), quats)
    assert torch.allclose(found, steps)


class Round(Vanilla):
    """Gaussians of one size each; the class says nothing of axes."""

    @override
    def create(self, scene, rng):
        tensors = super().create(scene, rng)
        scales = tensors["scales"].detach()[:, :1].clone().requires_grad_()
        return {**tensors, "scales": scales}

    @override
    def decode(self, parameters, camera, phase):
        return super().decode(
            {**parameters, "scales": parameters["scales"].expand(-1, 3)}, camera, phase
        )


class RoundWithAxes(Round):
    """Promises axes that it does not have."""

    axes = ("scales", "quats")


def with_backbone(backbone):
    setup = setup_of(initializer={"name": "points"})
    return replace(setup, selection=replace(setup.selection, backbone=backbone))


def test_a_derived_backbone_has_no_gaussian_axes_unless_it_declares_them():
    assert axes_of(with_backbone(Vanilla())) == ("means", "scales", "quats")
    assert axes_of(with_backbone(Round())) is None
    first_state(with_backbone(Round()))
    with pytest.raises(UserError, match="do not have the shapes of Gaussians") as caught:
        first_state(with_backbone(RoundWithAxes()))
    assert "(40, 1)" in caught.value.found


def setup_of(backbone="vanilla", **settings):
    choice = ComponentChoice.model_validate({"name": backbone, **OPTIONS.get(backbone, {})})
    return assemble(
        RunConfig(**{"steps": 10, "backbone": choice, **settings}), sample_scene(), "none"
    )


@pytest.mark.parametrize(
    ("settings", "by_size"),
    [
        ({}, True),
        ({"steps": 29_999}, True),
        ({"steps": 30_000}, False),
        ({"steps": 30_000, "position_lr": "per-axis"}, True),
        ({"position_lr": "extent"}, False),
        ({"recipe": {"name": "published"}}, False),
        ({"recipe": {"name": "published"}, "position_lr": "per-axis"}, True),
        ({"schedule": "absolute"}, False),
        ({"schedule": "absolute", "schedule_length": 10}, True),
    ],
)
def test_short_runs_use_position_steps_along_the_axes_of_gaussians(settings, by_size):
    assert (axes_of(setup_of(**settings)) is not None) == by_size


@pytest.mark.sampled(3)
@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_step_moves_positions_along_the_axes_of_their_gaussians(backbone):
    moved = {}
    for way in ("extent", "per-axis"):
        setup = setup_of(backbone, position_lr=None if backbone in ANCHORS else way)
        state = first_state(setup)
        names = setup.backbone.axes and (setup.backbone.positions, *setup.backbone.axes)
        before = {name: tensor.detach().clone() for name, tensor in state.parameters.items()}
        take_step(setup, state)
        after = {name: tensor.detach() for name, tensor in state.parameters.items()}
        moved[way] = before, after, names
    before, after, names = moved["per-axis"]
    if backbone in ANCHORS:
        assert axes_of(setup) is None
        return
    positions, *axes = names
    wanted = before[positions].clone()
    plain = moved["extent"][1][positions] - before[positions]
    step_along_axes(wanted, plain, *(after[name] for name in axes))
    # The difference of two positions has lost digits.
    assert torch.allclose(after[positions], wanted, atol=1e-6)
    assert not torch.allclose(after[positions], moved["extent"][1][positions], atol=1e-6)
    others = [name for name in after if name not in {positions, "filter"}]
    assert all(torch.equal(after[name], moved["extent"][1][name]) for name in others)


@pytest.mark.parametrize("backbone", sorted(ANCHORS))
def test_per_axis_steps_are_refused_for_a_backbone_without_axes(backbone):
    setup = setup_of(backbone)
    config = setup.config.model_copy(update={"position_lr": "per-axis"})
    with pytest.raises(UserError, match="does not train Gaussians with axes"):
        refuse_settings_for_nothing(config, setup)


def test_a_setting_missing_in_a_checkpoint_counts_as_unchanged():
    config = setup_of().config
    stored = settings_of(config)
    del stored["position_lr"]
    # A component, and an option of one, are known all the same.
    given = config.model_copy(update={"grouping": ComponentChoice(name="altitude")})
    fields = {name: {} for name in ("parameters", "exp_avg", "exp_avg_sq", "adam_steps")}
    rest = {"plugins": {}, "generators": {}, "scalars": {"settings": stored}}
    checkpoint = Checkpoint(step=1, **fields, **rest)
    check_settings(config, checkpoint)
    with pytest.raises(UserError, match=r"grouping\.name"):
        check_settings(given, checkpoint)
    stored["seed"] = 5
    with pytest.raises(UserError, match=r"settings in config\.yaml have changed"):
        check_settings(config, checkpoint)
