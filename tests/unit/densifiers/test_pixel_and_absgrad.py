"""The statistics of `pixel` and `absgrad` against loops over views and Gaussians in float64."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import NO_EDIT, PluginState
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import View
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.testing.support.renders import view_record
from crossgrad_plugins.densifiers.absgrad import AbsGradDensityControl, quantile
from crossgrad_plugins.densifiers.pixel import PixelDensityControl

CAMERA = posed_camera(200, 100, focal=90.0)
PRIMITIVES = 60


def parameters(rng):
    scales = rng.choice([0.004, 0.03], (PRIMITIVES, 1)).repeat(3, 1)
    return {
        "means": torch.from_numpy(rng.uniform(-1, 1, (PRIMITIVES, 3))).float(),
        "scales": torch.from_numpy(np.log(scales)).float(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(PRIMITIVES, 1),
        "opacities": torch.zeros(PRIMITIVES),
        "f_dc": torch.zeros(PRIMITIVES, 1, 3),
        "f_rest": torch.zeros(PRIMITIVES, 15, 3),
    }


def record(rng, means):
    """A view in which a third of the Gaussians is invisible."""
    n = len(means)
    seen = rng.integers(0, 3, n) > 0
    signed = rng.normal(0, 3e-6, (n, 2)) * seen[:, None]
    extra = rng.uniform(0, 6e-6, (n, 2)) * seen[:, None]
    screen = Screen(
        radii=torch.from_numpy(seen * rng.integers(1, 9, n)).int(),
        pixels=torch.from_numpy(seen * rng.integers(0, 50, n)).int(),
        mean_gradient=torch.from_numpy(signed).float(),
        abs_gradient=torch.from_numpy(np.abs(signed) + extra).float(),
    )
    gaussians = Gaussians(means, torch.zeros(n, 4), torch.ones(n, 3), torch.ones(n))
    view = View("a.jpg", CAMERA, None, "near", np.zeros(0, np.int64))
    return view_record(view, gaussians, screen)


def context(step, params, views):
    return DensifyContext(
        step=step,
        schedule=Schedule.for_run(30_000),
        scene=None,
        states={},
        rng=np.random.default_rng(0),
        parameters=params,
        backbone=Vanilla(),
        rasterizer=None,
        views=views,
        means_lr=1e-4,
        room=1000,
    )


def grown(densifier, rng, *, steps=(598, 599, 600), origin=None):
    """Parameters, all records and the edit of the last step."""
    params, state, records = parameters(rng), PluginState(), []
    edit = NO_EDIT
    for step in steps:
        means = params["means"] if origin is None else params["means"][origin]
        views = tuple(
            replace(view, gaussians=replace(view.gaussians, origin=origin))
            for view in (record(rng, means), record(rng, means))
        )
        records += views
        edit, state = densifier.densify(context(step, params, views), state)
    return params, records, edit


def pixel_statistic(records, threshold=0.37):
    """Primitive -> sum(m f |g|) / sum(m), from the definition."""
    totals, counts = np.zeros(PRIMITIVES), np.zeros(PRIMITIVES)
    pose = CAMERA.world_to_camera.numpy()
    for each in records:
        origin = each.gaussians.origin
        for i, mean in enumerate(each.gaussians.means.double().numpy()):
            depth = sum(pose[2, k] * mean[k] for k in range(3)) + pose[2, 3]
            factor = min(1.0, (depth / threshold) ** 2)
            gx, gy = each.screen.mean_gradient[i].double().tolist()
            m = int(each.screen.pixels[i])
            row = i if origin is None else int(origin[i])
            totals[row] += m * factor * hypot(gx * 100, gy * 50)
            counts[row] += m
    return np.divide(totals, counts, out=np.zeros(PRIMITIVES), where=counts > 0)


def mean_statistics(records, order):
    """Primitive -> g and ga, means over the renders in which it was visible."""
    g, ga, renders = np.zeros(PRIMITIVES), np.zeros(PRIMITIVES), np.zeros(PRIMITIVES)
    for each in records:
        for i in np.flatnonzero(each.screen.radii.numpy() > 0):
            gx, gy = each.screen.mean_gradient[i].double().tolist()
            ax, ay = each.screen.abs_gradient[i].double().tolist()
            g[i] += hypot(gx * 100, gy * 50)
            ga[i] += ax * 100 + ay * 50 if order == 1 else hypot(ax * 100, ay * 50)
            renders[i] += 1
    return g / np.maximum(renders, 1), ga / np.maximum(renders, 1)


def expected_source(params, clones, splits):
    """Old rows of the new set: survivors, clones, both children of each split."""
    small = np.exp(params["scales"][:, 0].double().numpy()) <= 0.01
    clones, splits = clones & small, splits & ~small
    assert clones.any() and splits.any() and not (clones | splits).all()
    parents = np.flatnonzero(splits)
    rows = [np.flatnonzero(~splits), np.flatnonzero(clones), parents, parents]
    return np.concatenate(rows).tolist()


@pytest.mark.parametrize("threshold", [0.37, 0.8])
def test_pixel_statistics_weight_by_pixels_and_scale_by_depth(threshold):
    densifier = PixelDensityControl(depth_threshold=threshold)
    params, records, edit = grown(densifier, np.random.default_rng(1))
    grows = pixel_statistic(records, threshold) >= 2e-4
    assert edit.source.tolist() == expected_source(params, grows, grows)


def test_pixel_statistics_add_up_over_the_gaussians_of_one_primitive():
    origin = torch.arange(2 * PRIMITIVES) % (PRIMITIVES - 3)
    params, records, edit = grown(PixelDensityControl(), np.random.default_rng(2), origin=origin)
    grows = pixel_statistic(records) >= 2e-4
    assert edit.source.tolist() == expected_source(params, grows, grows)


def test_no_gaussian_grows_without_pixels():
    rng = np.random.default_rng(3)
    params = parameters(rng)
    view = record(rng, params["means"])
    screen = replace(view.screen, pixels=torch.zeros(PRIMITIVES, dtype=torch.int32))
    views = (replace(view, screen=screen),)
    edit, _ = PixelDensityControl().densify(context(600, params, views), PluginState())
    assert edit.counts == {}


@pytest.mark.parametrize("criterion", ["abs", "gsplat", "quantile"])
def test_absgrad_criteria_agree_with_a_loop(criterion):
    densifier = AbsGradDensityControl(criterion=criterion)
    params, records, edit = grown(densifier, np.random.default_rng(4))
    g, ga = mean_statistics(records, order=1 if criterion == "quantile" else 2)
    clones, splits = {
        "abs": lambda: (g >= 2e-4, ga >= 4e-4),
        "gsplat": lambda: (ga >= 8e-4, ga >= 8e-4),
        "quantile": lambda: (by_quantile(g, ga), by_quantile(g, ga)),
    }[criterion]()
    assert edit.source.tolist() == expected_source(params, clones, splits)


def by_quantile(g, ga):
    share = np.mean(g >= 2e-4)
    chosen = (g >= 2e-4) | (ga >= np.quantile(ga, 1 - share))
    assert (g >= 2e-4).sum() < chosen.sum()
    return chosen


@pytest.mark.parametrize("scale", [0.0, 1e-6])
def test_the_quantile_criterion_grows_nothing_without_gradients(scale):
    rng = np.random.default_rng(5)
    params = parameters(rng)
    view = record(rng, params["means"])
    still = {n: getattr(view.screen, n) * scale for n in ("mean_gradient", "abs_gradient")}
    views = (replace(view, screen=replace(view.screen, **still)),)
    densifier = AbsGradDensityControl(criterion="quantile")
    edit, _ = densifier.densify(context(600, params, views), PluginState())
    assert edit.counts == {}


def test_the_quantile_criterion_omits_gaussians_that_were_never_visible():
    rng = np.random.default_rng(6)
    params = parameters(rng)
    view = record(rng, params["means"])
    fast = {n: getattr(view.screen, n) * 1e3 for n in ("mean_gradient", "abs_gradient")}
    views = (replace(view, screen=replace(view.screen, **fast)),)
    edit, _ = AbsGradDensityControl(criterion="quantile").densify(
        context(600, params, views), PluginState()
    )
    seen = view.screen.radii.numpy() > 0
    assert edit.source.tolist() == expected_source(params, seen, seen)


@pytest.mark.parametrize("share", [0.0, 0.37, 0.5, 1.0])
@pytest.mark.parametrize("number", [1, 2, 11])
def test_the_quantile_agrees_with_numpy(number, share):
    values = np.random.default_rng(7).normal(size=number)
    found = float(quantile(torch.from_numpy(values), share))
    assert found == pytest.approx(np.quantile(values, share), abs=1e-12)
