"""Children side by side on the longest axis, against what a sum of two Gaussians is."""

from dataclasses import replace
from functools import partial
from math import sqrt

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import PluginState, apply_to_parameters
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.renders import view_record
from crossgrad_plugins.densifiers.absgrad import AbsGradDensityControl
from crossgrad_plugins.densifiers.adc import AdaptiveDensityControl
from crossgrad_plugins.densifiers.multiview import MultiViewDensityControl
from crossgrad_plugins.densifiers.pixel import PixelDensityControl

CAMERA = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, torch.eye(4, dtype=torch.float64))
METHODS = [
    AdaptiveDensityControl,
    AbsGradDensityControl,
    PixelDensityControl,
    partial(MultiViewDensityControl, count="running", share=1.0, cap_opacity=1.0),
]


def parameters(seed=0, n=3):
    rng = np.random.default_rng(seed)
    tensors = {
        "means": rng.normal(size=(n, 3)),
        "scales": np.log(rng.uniform(0.002, 0.05, (n, 3))),
        "quats": rng.normal(size=(n, 4)),
        "opacities": rng.normal(0, 3, n),
        "f_dc": rng.normal(size=(n, 1, 3)),
        "f_rest": rng.normal(size=(n, 15, 3)),
    }
    return {name: torch.tensor(t).float().requires_grad_() for name, t in tensors.items()}


def context(params, *, room=100):
    """Every Gaussian asks to grow."""
    n = len(params["means"])
    gaussians = Gaussians(torch.ones(n, 3), torch.zeros(n, 4), torch.ones(n, 3), torch.ones(n))
    # The last one moves most.
    gradient = torch.full((n, 2), 1e-3) * (1 + torch.arange(n))[:, None]
    screen = Screen(torch.ones(n, dtype=torch.int32), mean_gradient=gradient)
    screen.abs_gradient, screen.pixels = gradient.clone(), torch.full((n,), 100.0)
    screen.count = lambda marked: torch.full((n,), 100, dtype=torch.int32)
    view = View("a.jpg", CAMERA, None, "near", np.zeros(0, np.int64))
    return DensifyContext(
        step=600,
        schedule=Schedule.for_run(30_000),
        scene=sample_scene(),
        states={},
        rng=np.random.default_rng(0),
        parameters=params,
        backbone=Vanilla(),
        rasterizer=None,
        views=(view_record(view, gaussians, screen),),
        means_lr=1e-4,
        room=room,
    )


def grown(densifier, params, **options):
    edit, _ = densifier.densify(context(params, **options), PluginState())
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    return edit, {name: tensor.detach().double() for name, tensor in new.items()}


def covariances(tensors):
    turns = Rotation.from_quat(np.roll(tensors["quats"].numpy(), -1, axis=1)).as_matrix()
    return turns * np.exp(2 * tensors["scales"].numpy())[:, None] @ turns.transpose(0, 2, 1)


@pytest.mark.parametrize("seed", range(5))
def test_two_children_have_the_mean_spread_and_mass_of_their_parent(seed):
    params = parameters(seed)
    edit, new = grown(AdaptiveDensityControl(division="axis"), params)
    assert dict(edit.counts) == {"cloned": 0, "split": 3, "pruned": 0}
    assert edit.source.tolist() == [0, 1, 2, 0, 1, 2]
    assert edit.fresh.all()
    old = {name: tensor.detach().double() for name, tensor in params.items()}
    means = new["means"].reshape(2, 3, 3).numpy()
    assert means.mean(axis=0) == pytest.approx(old["means"].numpy(), abs=1e-6)
    apart = (means[1] - means[0]) / 2
    spread = covariances(new).reshape(2, 3, 3, 3).mean(axis=0)
    spread += apart[:, :, None] * apart[:, None, :]
    assert spread == pytest.approx(covariances(old), rel=1e-4, abs=1e-9)
    mass = torch.sigmoid(new["opacities"]) * torch.exp(new["scales"].sum(dim=1))
    before = torch.sigmoid(old["opacities"]) * torch.exp(old["scales"].sum(dim=1))
    assert mass.reshape(2, 3).sum(dim=0).numpy() == pytest.approx(before.numpy(), rel=1e-5)


def test_children_are_placed_on_the_longest_axis():
    params = parameters()
    with torch.no_grad():
        params["quats"][:] = torch.tensor([1.0, 0, 0, 0])
        params["scales"][:] = torch.tensor([[1.0, 2, 3], [3, 2, 1], [1, 3, 2]]).log()
    _, new = grown(AdaptiveDensityControl(division="axis"), params)
    apart = (new["means"][3:] - new["means"][:3]).numpy()
    far = 2 * 3 * sqrt(1 - 0.6**2)
    assert apart == pytest.approx(far * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), abs=1e-5)
    assert torch.exp(new["scales"][0]).tolist() == pytest.approx([1.0, 2.0, 1.8])


@pytest.mark.parametrize("logit", [-40.0, -15.0, 15.0, 40.0])
def test_children_of_extreme_opacity_stay_finite(logit):
    params = parameters()
    with torch.no_grad():
        params["opacities"][:] = logit
    _, new = grown(AdaptiveDensityControl(prune_opacity=0.0, division="axis"), params)
    assert torch.isfinite(new["opacities"]).all()
    shares = torch.sigmoid(new["opacities"]) / torch.sigmoid(torch.tensor(logit).double())
    assert shares.numpy() == pytest.approx(1 / 1.2, rel=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("options", "sides"),
    [({}, False), ({"division": "axis"}, True), ({"division": "drawn"}, False)],
)
def test_children_are_placed_as_published_unless_the_run_selects_the_axis_split(
    method, options, sides
):
    params = parameters()
    edit, new = grown(method(**options), params)
    kept = len(new["means"]) - int(edit.fresh.sum())
    drawn, _ = grown(method(division="drawn"), params)
    assert kept == (0 if sides else int((~drawn.fresh).sum()))
    assert edit.counts["cloned"] == (0 if sides else drawn.counts["cloned"])


def test_the_strongest_gaussians_are_split_first_near_the_limit():
    edit, new = grown(AdaptiveDensityControl(division="axis"), parameters(), room=1)
    assert edit.source.tolist() == [0, 1, 2, 2]
    assert edit.counts["held_back"] == 2
    assert len(new["means"]) == 4


def test_gaussians_outside_may_grow_do_not_grow():
    params = parameters()
    ctx = replace(context(params), may_grow=torch.tensor([True, False, False]))
    edit, _ = AdaptiveDensityControl().densify(ctx, PluginState())
    assert edit.source.tolist() == [1, 2, 0, 0]


@pytest.mark.parametrize(
    ("densifier", "idle"),
    [
        (AdaptiveDensityControl(), False),
        (AdaptiveDensityControl(division="drawn"), False),
        (AdaptiveDensityControl(division="axis"), True),
        (PixelDensityControl(division="axis"), True),
        (AbsGradDensityControl(division="axis"), False),
        (AbsGradDensityControl(division="axis", criterion="gsplat"), True),
        (MultiViewDensityControl(division="axis"), False),
    ],
)
def test_split_scale_is_reported_as_unused_if_it_has_no_effect(densifier, idle):
    assert ("split_scale" in densifier.unused_options(None)) == idle
