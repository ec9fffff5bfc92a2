"""The photometric loss in plain torch: any device, any floating type, differentiable by autograd.

It is the readable definition and the oracle of the fused kernel.
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
    """The normalised one-dimensional window of SSIM, [11] float64."""
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
    """(1 - w) * L1 + w * (1 - SSIM), both averaged over the kept pixels and their channels.

    A masked-out pixel is 0 in both images before SSIM's windows are summed, has no term of its own
    in either mean, and receives exactly zero gradient. If no pixel is kept, the loss is 0.

    Args:
        image: [H, W, C] floating point; values may lie outside [0, 1].
        target: [H, W, C] floating point, or uint8 (then 255 means 1).
        mask: [H, W] bool, True where the pixel counts; None keeps all.
        ssim_weight: w in [0, 1].
        weights: [H, W] floating point, not negative: a pixel's share in both means. Windows of SSIM
            are summed as ever. None weighs all pixels alike.

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
    """The mean of [H, W, C] over the kept pixels by weight; 0 where no weight is kept."""
    share = masked(weights.to(values.dtype).unsqueeze(-1), mask)  # [H, W, 1]
    total = share.sum() * values.shape[-1]
    # Where nothing counts the sum is 0 already; what it is divided by must not be.
    return (masked(values, mask) * share).sum() / torch.where(total > 0, total, 1.0)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM of every pixel and channel, [H, W, C], windows zero-padded at the border.

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
    """The window where it is needed: copied there once, since a GPU is waited for meanwhile.

    Others may ask first who need no gradients: made without inference mode it serves all.
    """
    with torch.inference_mode(mode=False):
        return gaussian_window().to(device, dtype)


def blurred(fields: Tensor) -> Tensor:
    """Gaussian-weighted sums of [M, C, H, W] over the window around each pixel, same shape."""
    if fields.numel() == 0:
        return fields
    # One group per plane: torch's depthwise convolution is the fastest of its ways on the CPU.
    planes = fields.reshape(1, -1, *fields.shape[2:])  # [1, M * C, H, W]
    groups = planes.shape[1]
    weight = _window_for(fields.dtype, fields.device).expand(groups, 1, WINDOW)
    planes = conv2d(planes, weight.unsqueeze(-1), padding=(RADIUS, 0), groups=groups)
    planes = conv2d(planes, weight.unsqueeze(-2), padding=(0, RADIUS), groups=groups)
    return planes.view(fields.shape)
