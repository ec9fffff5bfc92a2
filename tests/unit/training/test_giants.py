"""Gaussians in which a camera stands are made smaller, and nothing else is."""

from math import log

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.giants import (
    EVERY,
    LARGE,
    LEAST,
    REACH,
    keep_off_cameras,
    nearest_camera,
)
from crossgrad_core.training.start import first_state

BACKBONES = ["vanilla", "mip", "pixel", "analytic", "distance"]


def started(backbone="vanilla", seed=0, **settings):
    """A state at a step that is due, with Gaussians of all sizes, turned and near the cameras."""
    choice = ComponentChoice.model_validate({"name": backbone})
    config = RunConfig(**{"steps": 1000, "backbone": choice, **settings})
    setup = assemble(config, sample_scene(), "none")
    state, rng = first_state(setup), np.random.default_rng(seed)
    state.step = EVERY
    with torch.no_grad():
        for name, tensor in state.tensors.items():
            if name in {"means", "scales", "quats"}:
                spread = {"means": 0.8, "scales": 1.5, "quats": 1.0}[name]
                mean = log(0.1) if name == "scales" else 0.0
                values = rng.normal(mean, spread, tuple(tensor.shape))
                tensor.copy_(torch.from_numpy(values).float())
    return setup, state


def distances(setup, state):
    """[N] by SciPy's rotations, Gaussian by Gaussian and camera by camera, and the largest size."""
    means, quats, scales = (
        state.tensors[name].detach().double().numpy() for name in ("means", "quats", "scales")
    )
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    found = [
        min(np.linalg.norm(turn.T @ (center - mean) / size) for center in setup.scene.centers)
        for mean, turn, size in zip(means, turns, np.exp(scales), strict=True)
    ]
    return np.array(found), np.exp(scales).max(axis=1)


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("seed", range(3))
def test_no_camera_stands_in_a_giant_afterwards(backbone, seed):
    setup, state = started(backbone, seed)
    away, largest = distances(setup, state)
    before = {name: tensor.detach().clone() for name, tensor in state.tensors.items()}
    inside = (away < 0.999 * REACH) & (largest > LARGE)
    assert 0 < inside.sum() < len(inside)
    assert keep_off_cameras(setup, state)
    after = distances(setup, state)[0]
    left = inside & (away > LEAST * REACH)
    np.testing.assert_allclose(after[left], REACH, rtol=1e-5)
    for name, tensor in state.tensors.items():
        rows = torch.from_numpy(~inside) if name == "scales" else slice(None)
        assert torch.equal(tensor[rows], before[name][rows]), name
    # All three axes alike: what it looks like stays.
    change = (state.tensors["scales"] - before["scales"]).detach()[torch.from_numpy(inside)]
    assert float((change - change[:, :1]).abs().max()) < 1e-5 and float(change.max()) < 0


def test_a_second_look_finds_nothing():
    setup, state = started()
    looks = sum(keep_off_cameras(setup, state) for _ in range(4))
    # One that was taken down as far as it goes at once is looked at again.
    assert 1 <= looks <= 3


def test_moments_stay():
    setup, state = started()
    shape = state.tensors["scales"].shape
    state.moments.exp_avg["scales"] = torch.full(shape, 0.5)
    state.moments.exp_avg_sq["scales"] = torch.full(shape, 0.25)
    assert keep_off_cameras(setup, state)
    assert bool((state.moments.exp_avg["scales"] == 0.5).all())
    assert bool((state.moments.exp_avg_sq["scales"] == 0.25).all())


@pytest.mark.parametrize(
    ("settings", "step"),
    [
        ({}, EVERY - 1),
        ({"floaters": "keep"}, EVERY),
        ({"preset": "inria"}, EVERY),
        ({"densifier": ComponentChoice(name="none")}, EVERY),
        (
            {"backbone": ComponentChoice.model_validate({"name": "scaffold", "voxel_size": 1e-2})},
            50,
        ),
    ],
    ids=str,
)
def test_when_nothing_is_made_smaller(settings, step):
    given = {"steps": 1000, **settings}
    setup = assemble(RunConfig(**given), sample_scene(), "none")
    state = first_state(setup)
    state.step = step
    with torch.no_grad():
        for name in ("scales", "log_scales"):
            if name in state.tensors:
                state.tensors[name].fill_(3.0)
    assert not keep_off_cameras(setup, state)


def test_it_is_looked_after_the_last_step():
    setup, state = started(steps=EVERY + 7)
    state.step = EVERY + 7
    assert keep_off_cameras(setup, state)


def test_numbers_that_are_none_are_left_to_those_who_look_for_them():
    setup, state = started()
    with torch.no_grad():
        state.tensors["scales"][:5] = float("nan")
        state.tensors["means"][5:10] = float("inf")
    keep_off_cameras(setup, state)
    assert bool(state.tensors["scales"][:5].isnan().all())


def test_distances_in_standard_deviations_by_hand():
    half = torch.tensor([[2.0, 0.0, 0.0, 2.0]])  # A quarter turn about z, not normalised.
    found = nearest_camera(
        torch.tensor([[1.0, 0.0, 0.0]]),
        half,
        torch.tensor([[2.0, 4.0, 1.0]]),
        torch.tensor([[1.0, 6.0, 0.0], [9.0, 0.0, 0.0]]),
    )
    # The long axis of 4 points along x after the turn, that of 2 along y.
    assert float(found) == pytest.approx(2.0)
