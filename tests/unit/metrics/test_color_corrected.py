"""Colour-corrected figures against numpy's least squares and closed forms."""

import numpy as np
import pytest
import torch

from crossgrad_core.plugin import Compared, psnr
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.metrics.color_correction import (
    ColorCorrectedPSNR,
    ColorCorrectedSSIM,
    color_corrected,
)
from crossgrad_plugins.metrics.ssim import ssim

SEEDS = range(6)


def compared(render, photo, mask=None):
    return Compared(sample_scene().test_views[0], render, photo, mask)


def image(seed, low=0, high=256, size=(23, 31)):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(low, high, (*size, 3), generator=generator, dtype=torch.uint8)


def by_lstsq(render, photo, mask=None):
    """The render after numpy's own least squares on [r, g, b, 1]."""
    flat, kept = render.reshape(-1, 3).double().numpy(), slice(None)
    if mask is not None:
        kept = mask.reshape(-1).numpy()
    ones = np.ones((len(flat), 1))
    rows = np.hstack([flat, ones])
    fit = np.linalg.lstsq(rows[kept], photo.reshape(-1, 3).double().numpy()[kept], rcond=None)[0]
    return np.rint(np.clip(rows @ fit, 0, 255)).reshape(render.shape).astype(np.uint8)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("masks", [False, True])
def test_the_colour_map_is_the_least_squares_solution(seed, masks):
    render, noise = image(seed, 40, 200), image(seed + 100, 0, 60)
    mixing = np.random.default_rng(seed).uniform(-0.3, 0.9, (3, 3))
    mixed = render.numpy() @ mixing + noise.numpy()
    photo = torch.from_numpy(np.clip(mixed, 0, 255).astype(np.uint8))
    mask = image(seed + 7)[..., 0] > 90 if masks else None
    found = color_corrected(compared(render, photo, mask))
    assert np.array_equal(found.numpy(), by_lstsq(render, photo, mask))


def test_differences_of_exposure_and_white_balance_are_corrected():
    photo = image(1, 30, 220)
    gains, offsets = torch.tensor([0.5, 0.8, 0.6]), torch.tensor([9.0, 0.0, 20.0])
    render = (photo * gains + offsets).round().to(torch.uint8)
    pair = compared(render, photo)
    assert psnr(render, photo) < 16
    assert ColorCorrectedPSNR().measure(pair) > 48  # what rounding to 8 bits leaves
    assert ColorCorrectedSSIM().measure(pair) > 0.995
    assert ssim(render, photo) < 0.9


@pytest.mark.parametrize("seed", SEEDS)
def test_correction_never_increases_the_error_by_more_than_rounding(seed):
    render, photo = image(seed), image(seed + 50)
    corrected = color_corrected(compared(render, photo))
    errors = [(each.double() - photo.double()).square().mean() for each in (corrected, render)]
    assert errors[0] <= errors[1] + 0.5  # squared levels


@pytest.mark.parametrize("grey", [0, 130, 255])
def test_a_render_of_one_colour_becomes_the_mean_of_the_photo(grey):
    photo = image(3)
    found = color_corrected(compared(torch.full_like(photo, grey), photo))
    mean = photo.double().mean(dim=(0, 1)).round().to(torch.uint8)
    assert torch.equal(found, mean.expand_as(photo))


def test_a_grey_render_is_fitted_by_its_brightness():
    brightness = image(4)[..., :1].expand(-1, -1, 3).contiguous()
    photo = (brightness * torch.tensor([0.9, 0.5, 0.2]) + 11).round().to(torch.uint8)
    found = color_corrected(compared(brightness, photo))
    assert (found.int() - photo.int()).abs().max() <= 1


def test_a_fully_masked_image_has_no_metric_value():
    render = image(0)
    pair = compared(render, render, torch.zeros(render.shape[:2], dtype=torch.bool))
    assert color_corrected(pair) is None
    assert ColorCorrectedPSNR().measure(pair) is None
    assert ColorCorrectedSSIM().measure(pair) is None


@pytest.mark.parametrize("kind", [ColorCorrectedPSNR, ColorCorrectedSSIM])
def test_the_metric_definition_in_the_results_states_the_fitted_colour_map(kind):
    told = kind().described().definition
    assert "affine" in told and "least squares" in told and "photo of the view" in told
