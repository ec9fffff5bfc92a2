"""PSNR and both SSIMs against closed forms, scikit-image and each other."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from crossgrad_core.contract.scene import to_uint8
from crossgrad_core.evaluation.evaluation import PSNR_LIMIT, psnr
from crossgrad_plugins.losses.photometric.reference import ssim_map
from crossgrad_plugins.metrics.ssim import ssim, ssim_skimage


def levels(seed, h=30, w=40):
    """A random 8-bit image."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (h, w, 3), generator=generator, dtype=torch.uint8)


IMAGE, TARGET = levels(0), levels(1)
MASK = torch.rand(30, 40, generator=torch.Generator().manual_seed(2)) < 0.6
NOTHING = torch.zeros(30, 40, dtype=torch.bool)


def test_to_uint8_clamps_rounds_and_is_idempotent():
    image = torch.tensor([[[-1.0, 0.5, 2.0], [torch.nan, 0.1, 1.0]]])
    expected = torch.tensor([[[0, 128, 255], [0, 26, 255]]], dtype=torch.uint8)
    assert torch.equal(to_uint8(image), expected)
    assert torch.equal(to_uint8(to_uint8(image)), expected)
    assert torch.equal(to_uint8(expected / 255), expected)


@pytest.mark.parametrize("step", [1, 7, 200])
def test_psnr_of_a_constant_difference_agrees_with_the_formula(step):
    image = torch.full((5, 6, 3), step, dtype=torch.uint8)
    expected = -20 * math.log10(step / 255)
    assert psnr(image, torch.zeros(5, 6, 3)) == pytest.approx(expected, rel=1e-12)


def test_psnr_counts_unmasked_pixels_only():
    spoiled = IMAGE.clone()
    spoiled[~MASK] = 0
    assert psnr(spoiled, TARGET, MASK) == psnr(IMAGE, TARGET, MASK)
    error = (IMAGE[MASK].double() - TARGET[MASK].double()) / 255
    expected = -10 * math.log10(error.square().mean().item())
    assert psnr(IMAGE, TARGET, MASK) == pytest.approx(expected, rel=1e-12)


def test_equal_images_have_the_highest_value_of_every_metric():
    assert psnr(IMAGE, IMAGE) == PSNR_LIMIT
    assert ssim(IMAGE, IMAGE) == 1
    assert ssim_skimage(IMAGE, IMAGE) == pytest.approx(1)


def test_psnr_of_one_step_in_one_value_is_below_the_limit():
    image = torch.zeros(100, 100, 3, dtype=torch.uint8)
    image[0, 0, 0] = 1
    assert psnr(image, torch.zeros(100, 100, 3)) == pytest.approx(92.9, abs=0.01)


@pytest.mark.parametrize("metric", [psnr, ssim, ssim_skimage])
def test_a_fully_masked_image_has_no_metric_value(metric):
    assert metric(IMAGE, TARGET, NOTHING) is None


@pytest.mark.parametrize("metric", [psnr, ssim, ssim_skimage])
def test_a_full_mask_equals_no_mask(metric):
    assert metric(IMAGE, TARGET, ~NOTHING) == metric(IMAGE, TARGET)


@pytest.mark.parametrize("metric", [psnr, ssim, ssim_skimage])
def test_uint8_and_float_images_have_the_same_metrics(metric):
    assert metric(IMAGE / 255, TARGET / 255) == metric(IMAGE, TARGET)


@pytest.mark.parametrize("mask", [None, MASK])
def test_ssim_is_the_mean_of_the_reference_map(mask):
    kept = MASK | True if mask is None else mask
    image, target = (torch.where(kept.unsqueeze(-1), i, 0).double() / 255 for i in (IMAGE, TARGET))
    expected = ssim_map(image, target)[kept].mean().item()
    assert ssim(IMAGE, TARGET, mask) == pytest.approx(expected, abs=1e-6)


def test_ssim_skimage_agrees_with_scikit_image():
    expected = structural_similarity(
        IMAGE.numpy(),
        TARGET.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=255,
        channel_axis=-1,
    )
    assert ssim_skimage(IMAGE, TARGET) == pytest.approx(expected, rel=1e-9)


def whole(image, target):
    """[H, W, 3] scikit-image's map of SSIM, of images in one piece."""
    _, full = structural_similarity(
        image.numpy() / 255,
        target.numpy() / 255,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    return full


@pytest.mark.parametrize("height", [128, 129, 133, 138, 139, 256, 261, 300])
def test_ssim_skimage_in_strips_has_the_bits_of_the_whole_image(height):
    random = torch.Generator().manual_seed(height)
    image, target = torch.randint(0, 256, (2, height, 40, 3), generator=random, dtype=torch.uint8)
    full = whole(image, target)
    inside = np.zeros((height, 40), dtype=bool)
    inside[5:-5, 5:-5] = True
    assert ssim_skimage(image, target) == full[inside].mean()


def test_both_ssims_agree_away_from_the_border():
    full = whole(IMAGE, TARGET)
    ours = ssim_map(IMAGE.double() / 255, TARGET.double() / 255).numpy()
    np.testing.assert_allclose(ours[5:-5, 5:-5], full[5:-5, 5:-5], atol=1e-9)


@pytest.mark.parametrize("shape", [(10, 40), (40, 10), (1, 1)])
def test_images_too_small_for_scikit_image_have_no_ssim_skimage(shape):
    image, target = levels(3, *shape), levels(4, *shape)
    assert ssim_skimage(image, target) is None
    assert ssim(image, target) is not None
    assert psnr(image, target) is not None
