"""Every backbone survives extreme parameters in both rasterizers, float32 stays near float64."""

import pytest
import torch
from support.extremes import cases, jittered, outcome

from crossgrad_core.registry.entries import build, offers
from crossgrad_core.testing.fixtures import sample_camera
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer
from crossgrad_plugins.rasterizers.torch_reference import TorchRasterizer

OURS = sorted(e.name for e in offers("backbones") if e.distribution == "crossgrad")
#: Gaussians whose compositing differs by rounding: a channel is off by much less than 1/255.
IMAGE, GRADIENT = 2e-5, 2e-3


def extreme(name, backbone, crowd=5_000):
    return cases(crowd)[name](jittered(backbone), sample_camera())


@pytest.mark.sampled(23)
@pytest.mark.parametrize("name", list(cases(1)))
@pytest.mark.parametrize("backbone", OURS)
def test_extreme_parameters_give_finite_results_close_to_float64(backbone, name):
    model = build("backbones", backbone, {})
    case = extreme(name, model)
    exact = outcome(model, TorchRasterizer(), case, torch.float64)
    assert exact.finite
    for rasterizer in (TorchRasterizer(), NumbaRasterizer()):
        found = outcome(model, rasterizer, case, torch.float32)
        assert found.finite
        assert found.image_error(exact) < IMAGE
        assert found.gradient_error(exact) < GRADIENT


@pytest.mark.sampled(1)
@pytest.mark.parametrize("backbone", OURS)
def test_a_million_gaussians_in_one_pixel_give_finite_results(backbone):
    model = build("backbones", backbone, {})
    found = outcome(
        model, NumbaRasterizer(), extreme("crowded pixel", model, 1_000_000), torch.float32
    )
    assert found.finite
    assert found.image.shape == (4, 4, 3)


@pytest.mark.slow
def test_the_reference_survives_a_million_gaussians_in_one_pixel():
    model = build("backbones", "vanilla", {"sh_degree": 0})
    case = extreme("crowded pixel", model, 1_000_000)
    exact = outcome(model, TorchRasterizer(), case, torch.float64)
    found = outcome(model, NumbaRasterizer(), case, torch.float32)
    assert exact.finite
    assert found.image_error(exact) < IMAGE
