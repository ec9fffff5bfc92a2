"""Binned directions of the reference against single pixels, one Gaussian after the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.brute_gradients import pixel_gradients
from support.gaussians import posed_camera, random_gaussians, smooth_gaussians

from crossgrad_core.registry.entries import build

OUTPUTS = frozenset({"directions", "abs_gradient", "depth", "pixels"})
CAMERA = posed_camera(80, 28, focal=40.0)


def leaves(gaussians, dtype=torch.float64):
    return gaussians.mapped(lambda t: t.detach().to(dtype, copy=True).requires_grad_())


def weighting(camera, seed=3):
    rng = torch.Generator().manual_seed(seed)
    shape = (camera.height, camera.width)
    channels = {"image": 3, "alpha": 1, "depth": 1}
    return {
        name: torch.randn(*shape, count, generator=rng, dtype=torch.float64)
        for name, count in channels.items()
    }


def drawn(gaussians, camera, weights, background=(0.0, 0.0, 0.0), name="torch", outputs=OUTPUTS):
    gaussians = leaves(gaussians, torch.float64 if name == "torch" else torch.float32)
    over = torch.tensor(background, dtype=gaussians.means.dtype)
    render = build("rasterizers", name, {}).render(gaussians, camera, over, outputs)
    loss = (render.image * weights["image"]).sum() + (render.alpha * weights["alpha"][..., 0]).sum()
    (loss + (render.depth * weights["depth"][..., 0]).sum()).backward()
    return render.screen


@pytest.mark.sampled(4)
@pytest.mark.parametrize("response", ["plain", "antialiased", "analytic"])
@pytest.mark.parametrize("seed", [0, 1])
def test_direction_bins_of_the_reference_agree_with_gradients_of_single_pixels(response, seed):
    gaussians = smooth_gaussians(25, CAMERA, seed=seed, response=response)
    weights, background = weighting(CAMERA), (0.3, 0.1, 0.6)
    found = drawn(gaussians, CAMERA, weights, background).directions.numpy()
    pixels = pixel_gradients(gaussians, CAMERA, weights=weights, background=background)
    expected = pixels.directions((CAMERA.width, CAMERA.height))
    assert found.shape == (25, 6, 5) and (expected[..., 4] > 0).any(0).all()
    assert found[..., 4].tolist() == expected[..., 4].tolist()
    assert found[..., 2:4] == pytest.approx(expected[..., 2:4], rel=1e-5, abs=1e-8)
    assert found[..., :2] == pytest.approx(expected[..., :2], abs=1e-4)


@pytest.mark.parametrize(
    ("name", "response"),
    [
        *[("torch", response) for response in ("plain", "antialiased", "analytic")],
        *[("numba", response) for response in ("plain", "antialiased")],
        # Its kernels take ten seconds to compile, and no other test uses them.
        pytest.param("numba", "analytic", marks=pytest.mark.slow),
    ],
)
def test_direction_bins_add_up_to_the_statistics_without_bins(name, response):
    gaussians = random_gaussians(80, CAMERA, response=response)
    screen = drawn(gaussians, CAMERA, weighting(CAMERA), name=name)
    total = screen.directions.double().sum(1)
    assert total[:, 2:4].numpy() == pytest.approx(screen.abs_gradient.numpy(), rel=1e-5, abs=1e-7)
    assert (total[:, 4] <= screen.pixels).all() and (total[:, 4] > 0).any()
    assert (total[:, :2].norm(dim=1) <= total[:, 4] * (1 + 1e-6)).all()
    # With nearly random weights next to no pixel has no gradient, save for capped ones.
    assert total[:, 4].sum() > 0.95 * screen.pixels.sum()


def one_gaussian(quat=(1.0, 0.0, 0.0, 0.0), scales=(0.2, 0.05, 0.05), opacity=0.5):
    """A Gaussian in the middle of an image, four units before a camera along z."""
    camera = replace(
        posed_camera(64, 48, focal=40.0, principal=(0.5, 0.5)),
        world_to_camera=torch.eye(4, dtype=torch.float64),
        fy=40.0,
    )
    gaussians = replace(
        random_gaussians(1, camera),
        means=torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64),
        quats=torch.tensor([quat], dtype=torch.float64),
        scales=torch.tensor([scales], dtype=torch.float64),
        opacities=torch.tensor([opacity], dtype=torch.float64),
    )
    return gaussians, camera


def brighter(camera):
    """A loss that wants every pixel brighter."""
    weights = {name: torch.zeros_like(weight) for name, weight in weighting(camera).items()}
    return {**weights, "image": -torch.ones_like(weights["image"])}


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_a_gaussian_under_opposite_gradients_has_opposite_directions_on_its_sides(name):
    # One standard deviation is 2 px along x; the mean lies on the border of two pixels.
    gaussians, camera = one_gaussian()
    bins = drawn(gaussians, camera, brighter(camera), name=name).directions[0]
    x, count = bins[:, 0], bins[:, 4]
    # To brighten pixels on the left it would move left, against its gradient.
    assert (x[:3] > 0).all() and (x[3:] < 0).all()
    assert x.tolist() == pytest.approx((-x.flip(0)).tolist(), rel=1e-4)
    assert bins[:, 1].tolist() == pytest.approx([0.0] * 6, abs=1e-4)
    assert count.tolist() == count.flip(0).tolist() and (count[1:5] == count[1]).all()


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_directions_refer_to_ndc_units(name):
    # Only the pixel at offset (3.5, 1.5) counts: its gradient is along that, per pixel.
    gaussians, camera = one_gaussian(scales=(0.3, 0.3, 0.3))
    weights = brighter(camera)
    keep = torch.zeros_like(weights["image"])
    keep[25, 35] = 1.0
    weights["image"] = weights["image"] * keep
    bins = drawn(gaussians, camera, weights, name=name).directions[0]
    assert bins[:, 4].tolist() == [0, 0, 0, 0, 1, 0]
    ndc = np.array([3.5 * 64, 1.5 * 48])
    assert bins[4, :2].numpy() == pytest.approx(-ndc / np.hypot(*ndc), rel=1e-5)
    assert (bins[4, 2] / bins[4, 3]).item() == pytest.approx(3.5 / 1.5, rel=1e-5)


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_an_axis_that_points_at_the_camera_has_one_direction_bin(name):
    # The longest axis points at the camera.
    gaussians, camera = one_gaussian(scales=(0.05, 0.05, 0.2))
    bins = drawn(gaussians, camera, brighter(camera), name=name).directions[0]
    assert bins[3, 4] > 0 and bins[[0, 1, 2, 4, 5]].eq(0).all()


@pytest.mark.parametrize("name", ["torch", "numba"])
@pytest.mark.parametrize("factor", [1e-30, 1e25])
def test_directions_do_not_depend_on_the_scale_of_the_loss(name, factor):
    gaussians = random_gaussians(30, CAMERA)
    weights = weighting(CAMERA)
    usual = drawn(gaussians, CAMERA, weights, name=name).directions
    scaled = {key: weight * factor for key, weight in weights.items()}
    other = drawn(gaussians, CAMERA, scaled, name=name).directions
    assert other.isfinite().all()
    assert other[..., [0, 1, 4]].numpy() == pytest.approx(usual[..., [0, 1, 4]].numpy(), abs=2e-3)


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_directions_are_left_out_if_not_requested(name):
    gaussians = random_gaussians(5, CAMERA)
    others = OUTPUTS - {"directions"}
    with_, without = (
        drawn(gaussians, CAMERA, weighting(CAMERA), name=name, outputs=outputs)
        for outputs in (OUTPUTS, others)
    )
    assert without.directions is None
    for field in ("radii", "pixels", "mean_gradient", "abs_gradient"):
        assert torch.equal(getattr(with_, field), getattr(without, field))
