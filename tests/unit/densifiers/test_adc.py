"""Adaptive density control against rules worked out by hand on a few Gaussians."""

from dataclasses import replace
from math import log

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_backbones.mip import MipSplatting
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import NO_EDIT, PluginState, apply_to_parameters
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.testing.fixtures import sample_phase, sample_scene
from crossgrad_core.testing.support.renders import view_record
from crossgrad_plugins.densifiers.adc import AdaptiveDensityControl

SCHEDULE = Schedule.for_run(30_000)
CAMERA = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, torch.eye(4, dtype=torch.float64))


def parameters(scales=(0.005, 0.02, 0.005, 0.02), opacities=(0.5, 0.5, 0.5, 0.5)):
    n = len(scales)
    return {
        "means": torch.arange(3.0 * n).reshape(n, 3).requires_grad_(),
        "scales": torch.tensor(scales).log()[:, None].repeat(1, 3).requires_grad_(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1).requires_grad_(),
        "opacities": torch.logit(torch.tensor(opacities)).requires_grad_(),
        "f_dc": torch.zeros(n, 1, 3).requires_grad_(),
        "f_rest": torch.zeros(n, 15, 3).requires_grad_(),
    }


def record(gradient, radii, origin=None):
    n = len(radii)
    gaussians = Gaussians(torch.zeros(n, 3), torch.zeros(n, 4), torch.ones(n, 3), torch.ones(n))
    screen = Screen(torch.tensor(radii, dtype=torch.int32), mean_gradient=torch.tensor(gradient))
    view = View("a.jpg", CAMERA, None, "near", np.zeros(0, np.int64))
    return view_record(view, replace(gaussians, origin=origin), screen)


def context(views, *, step, params=None, room=100, rng=0, backbone=None):
    return DensifyContext(
        step=step,
        schedule=SCHEDULE,
        scene=sample_scene(),
        states={},
        rng=np.random.default_rng(rng),
        parameters=params or parameters(),
        backbone=backbone or Vanilla(),
        rasterizer=None,
        views=tuple(views),
        means_lr=1e-4,
        room=room,
    )


# Gradient 1e-5 px^-1 in x is 1e-5 * W/2 = 1e-3 in NDC: above the threshold of 2e-4.
MOVING, STILL = [1e-5, 0.0], [1e-7, 0.0]


def test_the_gradient_statistic_is_the_mean_ndc_norm_over_visible_renders():
    adc = AdaptiveDensityControl()
    gradient = [[3e-6, 8e-6], [1.0, 1.0]]
    views = [record(gradient, [1, 0]), record([[0.0, 0.0], [0.0, 0.0]], [1, 0])]
    params = parameters((0.1, 0.1), (0.5, 0.5))
    _, state = adc.densify(context(views, step=1, params=params), PluginState())
    norm = np.hypot(3e-6 * 100, 8e-6 * 50)
    assert state.per_primitive["gradient"].tolist() == pytest.approx([norm, 0.0])
    assert state.per_primitive["renders"].tolist() == [2.0, 0.0]


def test_statistics_of_decoded_gaussians_are_added_to_their_primitives():
    view = record([[1e-5, 0.0]] * 3, [1, 1, 1], origin=torch.tensor([1, 1, 0]))
    params = parameters((0.1, 0.1), (0.5, 0.5))
    _, state = AdaptiveDensityControl().densify(
        context([view], step=1, params=params), PluginState()
    )
    assert state.per_primitive["renders"].tolist() == [1.0, 2.0]


def test_small_gaussians_are_cloned_large_ones_are_split_and_statistics_reset():
    view = record([MOVING, MOVING, STILL, STILL], [1, 1, 1, 1])
    params = parameters()
    ctx = context([view], step=600, params=params)
    edit, state = AdaptiveDensityControl().densify(ctx, PluginState())
    assert dict(edit.counts) == {"cloned": 1, "split": 1, "pruned": 0}
    assert edit.source.tolist() == [0, 2, 3, 0, 1, 1]
    assert edit.fresh.tolist() == [False, False, False, True, True, True]
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    assert torch.equal(new["means"][3], params["means"][0])
    assert new["scales"][4, 0].item() == pytest.approx(log(0.02 / 1.6))
    assert float(state.per_primitive["renders"].sum()) == 0


def test_children_of_a_split_are_sampled_from_their_parent():
    """A child is at mean + R (s n) with n standard normal. The parent is rotated and stretched."""
    rng = np.random.default_rng(5)
    params = parameters()
    with torch.no_grad():
        params["scales"][1] = torch.tensor([0.02, 0.05, 0.011]).log()
        params["quats"][1] = torch.from_numpy(rng.normal(size=4)).float()
    view = record([STILL, MOVING, STILL, STILL], [1] * 4)
    edit, _ = AdaptiveDensityControl().densify(
        context([view], step=600, params=params, rng=3), PluginState()
    )
    new = apply_to_parameters(edit, Vanilla().blocks(), params)
    draws = np.random.default_rng(3).standard_normal((2, 3))
    turn = Rotation.from_quat(np.roll(params["quats"][1].detach().double().numpy(), -1))
    offsets = turn.apply(np.array([0.02, 0.05, 0.011]) * draws)
    found = (new["means"][-2:] - params["means"][1]).detach().numpy()
    assert found == pytest.approx(offsets, rel=1e-4, abs=2e-6)
    assert edit.source.tolist()[-2:] == [1, 1]


def test_transparent_gaussians_are_pruned_and_large_ones_only_after_a_reset():
    params = parameters((0.005, 0.2, 0.005, 0.2), (0.001, 0.5, 0.5, 0.5))
    view = record([STILL] * 4, [1] * 4)
    early, _ = AdaptiveDensityControl().densify(
        context([view], step=600, params=params), PluginState()
    )
    assert early.source.tolist() == [1, 2, 3]
    late, _ = AdaptiveDensityControl().densify(
        context([view], step=3100, params=params), PluginState()
    )
    assert late.source.tolist() == [2]


def test_the_largest_gradients_grow_first_near_the_limit_and_skipped_gaussians_are_counted():
    view = record([[1e-5, 0], [3e-5, 0], [2e-5, 0], STILL], [1] * 4)
    ctx = context([view], step=600, params=parameters((0.005,) * 4), room=1)
    edit, _ = AdaptiveDensityControl().densify(ctx, PluginState())
    assert edit.source.tolist() == [0, 1, 2, 3, 1]
    assert edit.counts["held_back"] == 2


def test_a_reset_caps_opacities_and_clears_their_moments():
    params = parameters(opacities=(0.5, 0.006, 0.5, 0.5))
    view = record([STILL] * 4, [1] * 4)
    edit, _ = AdaptiveDensityControl().densify(
        context([view], step=3000, params=params), PluginState()
    )
    opacities = torch.sigmoid(edit.values["opacities"].values)
    assert opacities.tolist() == pytest.approx([0.01, 0.006, 0.01, 0.01])
    assert not edit.values["opacities"].keep_moments


def test_a_reset_with_an_edit_caps_the_opacity_rendered_after_the_edit():
    """The filter of backbone mip depends on the positions of the children."""
    backbone = MipSplatting()
    rng = np.random.default_rng(0)
    params = backbone.create(sample_scene(), rng)
    rows = len(params["means"])
    with torch.no_grad():
        params["means"] *= 2.0
        params["scales"][: rows // 2] = log(0.05)
        params["scales"][rows // 2 :] = log(0.002)
        params["opacities"][:] = 3.0
    view = record([MOVING] * (rows // 2) + [STILL] * (rows - rows // 2), [1] * rows)
    ctx = context([view], step=3000, params=params, backbone=backbone, room=10**6)
    edit, _ = AdaptiveDensityControl().densify(ctx, PluginState())
    assert edit.counts["split"] == rows // 2 and edit.counts["reset"] > 0
    after = apply_to_parameters(edit, backbone.blocks(), params)
    after = backbone.prepare(after, sample_scene(), sample_phase())
    drawn = backbone.splats(after, 0).opacities
    assert drawn.max().item() == pytest.approx(0.01, rel=1e-5)


def test_a_reset_without_an_edit_caps_the_opacity_rendered_with_the_current_filter():
    backbone = MipSplatting()
    params = backbone.create(sample_scene(), np.random.default_rng(0))
    rows = len(params["means"])
    with torch.no_grad():
        params["means"] *= 2.0
        params["opacities"][:] = 3.0
    view = record([STILL] * rows, [1] * rows)
    ctx = context([view], step=3000, params=params, backbone=backbone)
    edit, _ = AdaptiveDensityControl().densify(ctx, PluginState())
    assert edit.source is None
    after = apply_to_parameters(edit, backbone.blocks(), params)
    drawn = backbone.splats(after, 0).opacities
    assert drawn.max().item() == pytest.approx(0.01, rel=1e-5)


def test_nothing_changes_between_the_edits_and_after_the_end():
    adc = AdaptiveDensityControl()
    view = record([MOVING] * 4, [1] * 4)
    assert adc.densify(context([view], step=601), PluginState())[0] == NO_EDIT
    edit, state = adc.densify(context([view], step=15_000), PluginState())
    assert edit == NO_EDIT and not state.per_primitive
