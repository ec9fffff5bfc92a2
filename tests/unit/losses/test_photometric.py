"""The fused photometric loss against its definition, and the definition against closed forms."""

import numba
import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from crossgrad_plugins.losses.l1_ssim import _DeviceLoss, photometric_loss
from crossgrad_plugins.losses.photometric import reference as on_device
from crossgrad_plugins.losses.photometric.numba_kernels.fused import loss_terms
from crossgrad_plugins.losses.photometric.reference import (
    _window_for,
    gaussian_window,
    l1_ssim_loss,
    ssim_map,
)

H, W = 34, 46


def smooth_noise(seed, h=H, w=W):
    """A natural-looking image in [0, 1]: noise at several scales."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(3, h, w)
    for octave in range(4):
        cells = torch.rand(1, 3, 3 * 2**octave, 5 * 2**octave, generator=generator)
        image += interpolate(cells, (h, w), mode="bicubic")[0] / 2**octave
    return ((image - image.min()) / (image.max() - image.min())).permute(1, 2, 0).contiguous()


def noise(seed, h=H, w=W):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


NATURAL = smooth_noise(0)
BLURRED = smooth_noise(0) * 0.9 + 0.05 * smooth_noise(1)
FLAT = torch.full((H, W, 3), 0.7)
TILED = smooth_noise(1, 70, 400), smooth_noise(2, 70, 400)  # tiles in both directions
# name: image, target, bound on the gradient's relative error (L2)
CASES = {
    "random": (noise(1), noise(2), 1e-6),
    "natural": (BLURRED, NATURAL, 1e-5),
    "several tiles": (*TILED, 1e-5),
    "nearly equal": (NATURAL + 1e-3 * noise(3), NATURAL, 1e-5),
    "flat and noise": (FLAT + 1e-3 * noise(4), FLAT + 1e-3 * noise(5), 1e-5),
    "flat, other value": (FLAT, torch.full((H, W, 3), 0.71), 1e-5),
    "flat, far value": (torch.full((H, W, 3), 0.1), torch.full((H, W, 3), 0.9), 1e-5),
    "one colour": (FLAT * torch.tensor([1.0, 0, 0]), FLAT * torch.tensor([1.01, 0, 0]), 1e-5),
    "dark": (1e-3 * noise(6), 1e-3 * noise(7), 1e-5),
    "black against photo": (torch.zeros(H, W, 3), NATURAL, 1e-4),
    "black against white": (torch.zeros(H, W, 3), torch.ones(H, W, 3), 1e-4),
    "saturated": ((4 * BLURRED - 1.5).clamp(0, 1), (4 * NATURAL - 1.5).clamp(0, 1), 1e-4),
    "outside of [0, 1]": (5 * BLURRED - 2, NATURAL, 1e-4),
    "1 x 1": (noise(8, 1, 1), noise(9, 1, 1), 1e-5),
    "one row": (noise(10, 1, 800), noise(11, 1, 800), 1e-5),
    "two columns": (noise(12, 131, 2), noise(13, 131, 2), 1e-5),
    "smaller than the window": (noise(14, 7, 10), noise(15, 7, 10), 1e-5),
}


def random_mask(shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(16)) < 0.7


def block_mask(shape):
    mask = torch.ones(shape, dtype=torch.bool)
    mask[shape[0] // 3 :, : shape[1] // 2 + 1] = False
    return mask


MASKS = {"all": lambda _: None, "random": random_mask, "block": block_mask}


def loss_and_gradient(loss, image, *rest):
    image = image.clone().requires_grad_()
    value = loss(image, *rest)
    value.backward()
    return value.item(), image.grad


@pytest.mark.sampled(35)
@pytest.mark.parametrize("ssim_weight", [0.2, 1.0])
@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS)
@pytest.mark.parametrize(("image", "target", "bound"), CASES.values(), ids=CASES)
def test_fused_agrees_with_the_float64_reference(image, target, bound, mask, ssim_weight):
    kept = mask(image.shape[:2])
    value, gradient = loss_and_gradient(photometric_loss, image, target, kept, ssim_weight)
    expected, exact = loss_and_gradient(
        l1_ssim_loss, image.double(), target.double(), kept, ssim_weight
    )
    assert value == pytest.approx(expected, abs=1e-6)
    assert (gradient - exact).norm() <= bound * exact.norm()


@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS)
def test_a_uint8_target_is_divided_by_255(mask):
    target = (NATURAL * 255).round().to(torch.uint8)
    kept = mask((H, W))
    from_bytes = loss_and_gradient(photometric_loss, BLURRED, target, kept)
    from_floats = loss_and_gradient(photometric_loss, BLURRED, target.float() / 255, kept)
    assert from_bytes[0] == from_floats[0]
    assert torch.equal(from_bytes[1], from_floats[1])
    reference = l1_ssim_loss(BLURRED.double(), target, kept)
    assert from_bytes[0] == pytest.approx(reference.item(), rel=1e-6)


@pytest.mark.parametrize("image", [NATURAL, FLAT, torch.zeros(H, W, 3)])
def test_equal_images_have_no_loss_and_no_gradient(image):
    value, gradient = loss_and_gradient(photometric_loss, image, image, None)
    assert value == 0
    assert not gradient.any()


@pytest.mark.parametrize("loss", [photometric_loss, l1_ssim_loss])
def test_a_fully_masked_image_has_zero_loss(loss):
    nothing = torch.zeros(H, W, dtype=torch.bool)
    value, gradient = loss_and_gradient(loss, BLURRED, NATURAL, nothing)
    assert value == 0
    assert not gradient.any()


@pytest.mark.parametrize("loss", [photometric_loss, l1_ssim_loss])
def test_masked_pixels_change_neither_the_loss_nor_its_gradient(loss):
    kept = block_mask((H, W))
    spoiled = torch.where(kept.unsqueeze(-1), BLURRED, torch.nan)
    clean = loss_and_gradient(loss, BLURRED, NATURAL, kept)
    dirty = loss_and_gradient(loss, spoiled, NATURAL, kept)
    assert clean[0] == dirty[0]
    assert torch.equal(clean[1], dirty[1])
    assert not clean[1][~kept].any()


def test_a_full_mask_equals_no_mask():
    full = torch.ones(H, W, dtype=torch.bool)
    masked = loss_and_gradient(photometric_loss, BLURRED, NATURAL, full)
    plain = loss_and_gradient(photometric_loss, BLURRED, NATURAL, None)
    assert masked[0] == plain[0]
    assert torch.equal(masked[1], plain[1])


def test_bits_do_not_depend_on_the_number_of_threads():
    before = numba.get_num_threads()
    results = []
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            results.append(loss_and_gradient(photometric_loss, *TILED, None))
    finally:
        numba.set_num_threads(before)
    for value, gradient in results:
        assert value == results[0][0]
        assert torch.equal(gradient, results[0][1])


def test_bits_do_not_depend_on_the_scratch_memory_of_earlier_tiles():
    image, target = (tensor.numpy() for tensor in TILED)
    alone, again = np.empty_like(image), np.empty_like(image)
    first = loss_terms(image, target, None, alone)
    loss_terms(np.full_like(image, np.nan), target, None, again)
    assert loss_terms(image, target, None, again) == first
    np.testing.assert_array_equal(alone, again)


def test_omitting_the_gradient_keeps_the_value():
    image, target = BLURRED.numpy(), NATURAL.numpy()
    assert loss_terms(image, target) == loss_terms(image, target, None, np.empty_like(image))


def test_the_gradient_scales_with_the_upstream_gradient():
    image = BLURRED.clone().requires_grad_()
    loss = photometric_loss(image, NATURAL)
    (once,) = torch.autograd.grad(loss, image, retain_graph=True)
    (thrice,) = torch.autograd.grad(3 * loss, image)
    torch.testing.assert_close(thrice, 3 * once)


def test_nan_in_the_image_gives_a_nan_loss():
    image = BLURRED.clone()
    image[3, 5, 1] = torch.nan
    value, gradient = loss_and_gradient(photometric_loss, image, NATURAL, None)
    assert np.isnan(value)
    assert torch.isfinite(gradient[20:]).all()


def test_other_memory_layouts_and_types_give_the_same_loss():
    transposed = NATURAL.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    plain = photometric_loss(BLURRED, NATURAL)
    assert photometric_loss(BLURRED, transposed) == plain
    assert photometric_loss(BLURRED, NATURAL.double()) == plain
    double = photometric_loss(BLURRED.double(), NATURAL.double())
    assert double.dtype == torch.float64
    assert double.item() == pytest.approx(plain.item(), rel=1e-6)


@pytest.mark.parametrize("kept", [None, random_mask((5, 7))])
def test_the_reference_gradient_agrees_with_finite_differences(kept):
    image, target = noise(17, 5, 7).double().requires_grad_(), noise(18, 5, 7)
    assert torch.autograd.gradcheck(lambda x: l1_ssim_loss(x, target, kept), image, fast_mode=True)


def test_the_ssim_window_is_a_normalised_gaussian():
    window = gaussian_window()
    assert window.sum().item() == pytest.approx(1, abs=1e-15)
    assert (window[6] / window[5]).item() == pytest.approx(np.exp(-1 / (2 * 1.5**2)))


def test_ssim_of_constant_images_is_the_luminance_term_away_from_the_border():
    x, y = 0.3, 0.6
    images = (torch.full((13, 13, 3), value, dtype=torch.float64) for value in (x, y))
    inside = ssim_map(*images)[6, 6]
    expected = (2 * x * y + 1e-4) / (x * x + y * y + 1e-4)
    assert inside.numpy() == pytest.approx(np.full(3, expected), rel=1e-12)


def test_ssim_of_one_pixel_includes_the_zero_padding():
    x, y, w = 0.4, 0.5, gaussian_window()[5].item() ** 2
    luminance = (2 * w * x * w * y + 1e-4) / ((w * x) ** 2 + (w * y) ** 2 + 1e-4)
    variances = (w - w * w) * (x * x + y * y)
    contrast = (2 * (w - w * w) * x * y + 9e-4) / (variances + 9e-4)
    images = (torch.full((1, 1, 1), value, dtype=torch.float64) for value in (x, y))
    assert ssim_map(*images).item() == pytest.approx(luminance * contrast, rel=1e-12)


@pytest.mark.parametrize(
    ("image", "target", "mask"),
    [
        (torch.zeros(4, 4), torch.zeros(4, 4), None),
        (torch.zeros(4, 4, 3), torch.zeros(4, 5, 3), None),
        (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), torch.ones(4, 5, dtype=torch.bool)),
        (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), torch.ones(4, 4)),
    ],
)
def test_invalid_shapes_are_refused(image, target, mask):
    with pytest.raises(ValueError, match="must"):
        photometric_loss(image, target, mask)


@pytest.mark.sampled(11)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_the_analytic_gradient_agrees_with_autograd(name, masked):
    """Test the formula of the GPU loss.

    In float32, its error must not exceed the error of autograd.
    """
    image, target, _ = CASES[name]
    mask = random_mask(image.shape[:2]) if masked else None
    value, gradient = loss_and_gradient(l1_ssim_loss, image.double(), target.double(), mask)

    def errors(found):
        loss, slope = found
        return abs(float(loss) - float(value)), float((slope.double() - gradient).norm())

    exact = errors(on_device.loss_and_gradient(image.double(), target.double(), mask, 0.2))
    close = errors(on_device.loss_and_gradient(image, target, mask, 0.2))
    usual = errors(loss_and_gradient(l1_ssim_loss, image, target, mask))
    for size, fine, coarse, other in zip(
        (float(value), float(gradient.norm())), exact, close, usual, strict=True
    ):
        assert fine <= 1e-10 * size
        assert coarse <= 2 * other + 2e-6 * size


@pytest.mark.parametrize("ssim_weight", [0.0, 1.0])
@pytest.mark.parametrize("kept", [None, "none", "one"])
def test_the_analytic_gradient_is_correct_for_extreme_weights_and_masks(ssim_weight, kept):
    """Masked pixels may have any value."""
    image, target = BLURRED.double(), NATURAL.double()
    mask = None if kept is None else torch.zeros(image.shape[:2], dtype=torch.bool)
    if mask is not None:
        image = torch.where(mask[..., None], image, torch.nan)
    if kept == "one":
        mask[7, 9], image[7, 9] = True, BLURRED[7, 9].double()
    value, gradient = loss_and_gradient(l1_ssim_loss, image, target, mask, ssim_weight)
    found, slope = on_device.loss_and_gradient(image, target, mask, ssim_weight)
    assert found.item() == pytest.approx(value, rel=1e-12, abs=1e-15)
    torch.testing.assert_close(slope, gradient.nan_to_num(), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("image", [NATURAL, FLAT, torch.zeros(H, W, 3), torch.zeros(0, 4, 3)])
def test_the_analytic_gradient_of_equal_images_is_zero(image):
    value, slope = on_device.loss_and_gradient(image, image, None, 0.2)
    assert value.item() == 0.0
    assert slope.shape == image.shape
    assert not slope.any()


def test_the_gpu_loss_multiplies_its_gradient_by_the_upstream_gradient():
    """Run on the CPU. The upstream gradient is a factor of any sign."""
    image = BLURRED.clone().requires_grad_()
    loss = _DeviceLoss.apply(image, NATURAL, None, 0.2)
    (found,) = torch.autograd.grad(-3.0 * loss, image)
    expected = on_device.loss_and_gradient(BLURRED, NATURAL, None, 0.2)[1]
    torch.testing.assert_close(found, -3.0 * expected)


def test_a_window_cached_in_inference_mode_can_be_used_with_gradients():
    _window_for.cache_clear()
    with torch.inference_mode():
        ssim_map(BLURRED.double(), NATURAL.double())
    image = BLURRED.double().requires_grad_()
    l1_ssim_loss(image, NATURAL.double()).backward()
    assert image.grad.any()


def test_the_analytic_gradient_divides_uint8_photos_by_255():
    photo = (255 * NATURAL).round().to(torch.uint8)
    found = on_device.loss_and_gradient(BLURRED, photo, None, 0.2)
    expected = on_device.loss_and_gradient(BLURRED, photo.float() / 255, None, 0.2)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
