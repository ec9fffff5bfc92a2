"""The photometric loss in plain torch: by autograd, or with an explicit gradient for a GPU.

This is the readable definition, and the reference for tests of the fused kernel.

Autograd launches more kernels, and most of them run for less time than their launch takes. The
explicit gradient uses sums and differences, as the fused CPU kernel does (`numba_kernels.fused`).
The explicit gradient filters twelve planes forward and nine backward, while autograd filters
fifteen each.
"""

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from crossgrad_core.plugin import masked, unit_range

WINDOW = 11  # pixels
RADIUS = WINDOW // 2
SIGMA = 1.5  # pixels
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
    """Return (1 - w) * L1 + w * (1 - SSIM), both averaged over the unmasked pixels and channels.

    A masked pixel is 0 in both images before SSIM's windows are summed. A masked pixel contributes
    to neither mean, and receives exactly zero gradient. If no pixel counts, the loss is 0.

    Args:
        image: [H, W, C] floating point; values may be outside [0, 1].
        target: [H, W, C] floating point, or uint8 (then 255 means 1).
        mask: [H, W] bool, True where the pixel counts; None counts all pixels.
        ssim_weight: w in [0, 1].
        weights: [H, W] floating point, not negative: a pixel's weight in both means. The weights do
            not affect the window sums of SSIM. None gives all pixels the same weight.

    Returns:
        Scalar of the image's type.

    Source: Kerbl et al. 2023 (3D Gaussian Splatting), eq. 7, with 1 - SSIM as D-SSIM.
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
    """Return the weighted mean of [H, W, C] over the kept pixels; 0 if the total weight is 0."""
    share = masked(weights.to(values.dtype).unsqueeze(-1), mask)  # [H, W, 1]
    total = share.sum() * values.shape[-1]
    # If no pixel counts, the sum is already 0, but the divisor must not be 0.
    return (masked(values, mask) * share).sum() / torch.where(total > 0, total, 1.0)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the SSIM of every pixel and channel, [H, W, C]; windows are zero-padded.

    Args:
        image: [H, W, C] floating point.
        target: [H, W, C] of the same type.

    Source: Wang et al. 2004, eq. 13, 11 x 11 Gaussian window, sigma 1.5, L = 1.
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
    """Return the window on a device, copied only once, because a copy synchronises with the GPU.

    The first call may be in inference mode. The window is created outside inference mode, so that
    calls with gradients can also use it.
    """
    with torch.inference_mode(mode=False):
        return gaussian_window().to(device, dtype)


def blurred(fields: Tensor) -> Tensor:
    """Return Gaussian-weighted sums of [M, C, H, W] over each pixel's window, same shape."""
    if fields.numel() == 0:
        return fields
    # Use one group per plane, because torch's depthwise convolution is the fastest variant on the
    # CPU.
    planes = fields.reshape(1, -1, *fields.shape[2:])  # [1, M * C, H, W]
    groups = planes.shape[1]
    weight = _window_for(fields.dtype, fields.device).expand(groups, 1, WINDOW)
    planes = conv2d(planes, weight.unsqueeze(-1), padding=(RADIUS, 0), groups=groups)
    planes = conv2d(planes, weight.unsqueeze(-2), padding=(0, RADIUS), groups=groups)
    return planes.view(fields.shape)


@torch.no_grad()
def loss_and_gradient(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
) -> tuple[Tensor, Tensor]:
    """Return the value of `l1_ssim_loss`, and its gradient with respect to the image [H, W, C].

    Args:
        image: [H, W, C] floating point.
        target: [H, W, C] floating point, or uint8 (then 255 means 1).
        mask: [H, W] bool; None counts all pixels.
        ssim_weight: w in [0, 1].
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
    """Return 1 - SSIM of every pixel [C, H, W], and the gradient of the SSIM sum over kept pixels.

    Args:
        sums: [C, H, W] image plus target.
        differences: [C, H, W] image minus target.
        mask: [H, W] bool; None counts all pixels.
    """
    fields = torch.stack((sums, differences, sums * sums, differences * differences))
    mean_s, mean_d, square_s, square_d = blurred(fields)
    dark, bright = mean_d * mean_d, mean_s * mean_s
    # Rounding may make a variance of zero slightly negative.
    variance_s = (square_s - bright).clamp_(min=0.0).add_(2 * C2)
    variance_d = (square_d - dark).clamp_(min=0.0)
    bright.add_(2 * C1)
    over_mean, over_variance = 1 / (bright + dark), 1 / (variance_s + variance_d)
    # 1 minus the luminance term, and 1 minus the contrast-structure term. Both are 0 if the images
    # are equal.
    luminance, contrast = 2 * dark * over_mean, 2 * variance_d * over_variance
    dissimilarity = luminance + contrast - luminance * contrast
    by_variance = (1 - luminance).mul_(over_variance).mul_(over_variance).mul_(4)
    by_s, by_d = by_variance * variance_d, by_variance.mul_(variance_s).neg_()
    by_mean = (1 - contrast).mul_(over_mean).mul_(over_mean).mul_(mean_s * dark - mean_d * bright)
    by_mean.mul_(4).sub_(mean_s * by_s + mean_d * by_d)
    slopes = torch.stack((by_mean, by_s, by_d))
    if mask is not None:
        slopes *= mask
    # The window is symmetric, so the adjoint operation is the same filter.
    of_mean, of_s, of_d = blurred(slopes)
    return dissimilarity, of_mean.addcmul_(sums, of_s).addcmul_(differences, of_d)
