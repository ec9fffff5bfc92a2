"""The photometric loss in plain torch, by autograd or with an explicit gradient for a GPU.

This module is the readable definition of the loss, and the reference for tests of the compiled
kernel.

On a GPU, autograd launches more kernels, and most of these kernels take less time than their
launch. The explicit gradient uses s = x + y and d = x - y, as the compiled CPU kernel does
(`numba_kernels.fused`). It filters twelve planes in the forward pass and nine in the backward pass.
Autograd filters fifteen planes in each pass.
"""

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from crossgrad_core.plugin import masked, unit_range

WINDOW = 11
RADIUS = WINDOW // 2
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def gaussian_window() -> Tensor:
    """Return the normalised one-dimensional window of SSIM, [11] float64."""
    offset = torch.arange(WINDOW, dtype=torch.float64) - RADIUS
    weight = torch.exp(-(offset**2) / (2 * SIGMA**2))
    return weight / weight.sum()


def l1_ssim_loss(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    ssim_weight: float = 0.2,
    weights: Tensor | None = None,
) -> Tensor:
    """Return (1 - w) * L1 + w * (1 - SSIM), both averaged over unmasked pixels and channels.

    A masked pixel is set to 0 in both images before the window sums of SSIM. A masked pixel does
    not enter the two means, and its gradient is exactly zero. If no pixel counts, the loss is 0.

    Args:
        image: [H, W, C] the render, floating point; values may be outside [0, 1].
        target: [H, W, C] the photo, floating point, or uint8 with 255 for 1.
        mask: [H, W] bool, True for pixels that count; None if all pixels count.
        ssim_weight: The weight w of the SSIM term, in [0, 1].
        weights: [H, W] non-negative weights of the pixels in both means, floating point. The
            weights do not affect the window sums of SSIM. None means equal weights.

    Returns:
        The loss, a scalar of the image's type.

    Source: Kerbl et al. 2023 (3D Gaussian Splatting), eq. 7, with 1 - SSIM for D-SSIM.
    """
    image, target = masked(image, mask), masked(unit_range(target, image.dtype), mask)
    absolute = (image - target).abs()
    dissimilarity = 1 - ssim_map(image, target)
    if weights is not None:
        return _weighted((1 - ssim_weight) * absolute + ssim_weight * dissimilarity, mask, weights)
    if mask is None:
        count = torch.full((), max(image.numel(), 1), dtype=image.dtype, device=image.device)
    else:
        dissimilarity = masked(dissimilarity, mask)
        count = (mask.sum() * image.shape[-1]).clamp(min=1)
    loss: Tensor = (1 - ssim_weight) * absolute.sum() + ssim_weight * dissimilarity.sum()
    return loss / count


def _weighted(values: Tensor, mask: Tensor | None, weights: Tensor) -> Tensor:
    """Return the weighted mean of [H, W, C] over unmasked pixels; 0 if the total weight is 0."""
    share = masked(weights.to(values.dtype).unsqueeze(-1), mask)
    total = share.sum() * values.shape[-1]
    # If no pixel counts, the sum is 0, and the divisor must not be 0.
    return (masked(values, mask) * share).sum() / torch.where(total > 0, total, 1.0)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return [H, W, C] SSIM of every pixel and channel; windows are padded with zeros.

    Args:
        image: [H, W, C] the render, floating point.
        target: [H, W, C] the photo, of the same type.

    Source: Wang et al. 2004, eq. 13, with an 11 x 11 Gaussian window, sigma 1.5 and dynamic range L
    = 1.
    """
    x, y = image, target
    fields = torch.stack((x, y, x * x, y * y, x * y)).permute(0, 3, 1, 2)
    mean_x, mean_y, xx, yy, xy = blurred(fields).permute(0, 2, 3, 1)
    variance_x = xx - mean_x * mean_x
    variance_y = yy - mean_y * mean_y
    covariance = xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    contrast_structure = (2 * covariance + C2) / (variance_x + variance_y + C2)
    ssim: Tensor = luminance * contrast_structure
    return ssim


@cache
def _window_for(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the window on a device.

    The window is copied only once, because a copy synchronises with the GPU. The first call may
    happen in inference mode. The window is therefore created outside inference mode, so that later
    calls with gradients can use it.
    """
    with torch.inference_mode(mode=False):
        return gaussian_window().to(device, dtype)


def blurred(fields: Tensor) -> Tensor:
    """Return [M, C, H, W] Gaussian-weighted sums over the window of each pixel."""
    if fields.numel() == 0:
        return fields
    # Use one convolution group per plane, because this is torch's fastest variant on the CPU.
    planes = fields.reshape(1, -1, *fields.shape[2:])
    groups = planes.shape[1]
    weight = _window_for(fields.dtype, fields.device).expand(groups, 1, WINDOW)
    planes = conv2d(planes, weight.unsqueeze(-1), padding=(RADIUS, 0), groups=groups)
    planes = conv2d(planes, weight.unsqueeze(-2), padding=(0, RADIUS), groups=groups)
    return planes.view(fields.shape)


@torch.no_grad()
def loss_and_gradient(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
) -> tuple[Tensor, Tensor]:
    """Return the value of `l1_ssim_loss`, and its gradient [H, W, C] with respect to the image.

    Args:
        image: [H, W, C] the render, floating point.
        target: [H, W, C] the photo, floating point, or uint8 with 255 for 1.
        mask: [H, W] bool; None if all pixels count.
        ssim_weight: The weight w of the SSIM term, in [0, 1].
    """
    x = masked(image, mask).permute(2, 0, 1)
    y = masked(unit_range(target, image.dtype), mask).permute(2, 0, 1)
    sums, differences = x + y, x - y
    dissimilarity, slope = _dissimilarity_and_slope(sums, differences, mask)
    count: Tensor | int = max(image.numel(), 1)
    if mask is not None:
        dissimilarity *= mask
        count = (mask.sum() * image.shape[-1]).clamp(min=1)
    loss = (1 - ssim_weight) * differences.abs().sum() + ssim_weight * dissimilarity.sum()
    gradient = differences.sign_().mul_(1 - ssim_weight).sub_(slope, alpha=ssim_weight).div_(count)
    if mask is not None:
        gradient *= mask
    return loss / count, gradient.permute(1, 2, 0).contiguous()


def _dissimilarity_and_slope(
    sums: Tensor, differences: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return 1 - SSIM [C, H, W], and the gradient of the SSIM sum over unmasked pixels.

    Args:
        sums: [C, H, W] image plus target.
        differences: [C, H, W] image minus target.
        mask: [H, W] bool; None if all pixels count.
    """
    fields = torch.stack((sums, differences, sums * sums, differences * differences))
    mean_s, mean_d, square_s, square_d = blurred(fields)
    dark, bright = mean_d * mean_d, mean_s * mean_s
    # Rounding can make a variance of zero slightly negative.
    variance_s = (square_s - bright).clamp_(min=0.0).add_(2 * C2)
    variance_d = (square_d - dark).clamp_(min=0.0)
    bright.add_(2 * C1)
    over_mean, over_variance = 1 / (bright + dark), 1 / (variance_s + variance_d)
    # One minus the luminance term, and one minus the contrast-structure term. Both values are 0 if
    # the images are equal.
    luminance, contrast = 2 * dark * over_mean, 2 * variance_d * over_variance
    dissimilarity = luminance + contrast - luminance * contrast
    by_variance = (1 - luminance).mul_(over_variance).mul_(over_variance).mul_(4)
    by_s, by_d = by_variance * variance_d, by_variance.mul_(variance_s).neg_()
    by_mean = (1 - contrast).mul_(over_mean).mul_(over_mean).mul_(mean_s * dark - mean_d * bright)
    by_mean.mul_(4).sub_(mean_s * by_s + mean_d * by_d)
    slopes = torch.stack((by_mean, by_s, by_d))
    if mask is not None:
        slopes *= mask
    # The window is symmetric, so the transposed filter of the backward pass is the filter itself.
    of_mean, of_s, of_d = blurred(slopes)
    return dissimilarity, of_mean.addcmul_(sums, of_s).addcmul_(differences, of_d)
