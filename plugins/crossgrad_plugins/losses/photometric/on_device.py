"""The photometric loss and its gradient at once, in plain torch without autograd, for a GPU.

Autograd would launch some ninety kernels, most of them shorter than launching them takes. Written
out it is half as many, and nine planes are filtered in the backward pass instead of fifteen.
"""

import torch
from torch import Tensor

from crossgrad_core.plugin import masked, unit_range
from crossgrad_plugins.losses.photometric.reference import C1, C2, blurred


@torch.no_grad()
def loss_and_gradient(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
) -> tuple[Tensor, Tensor]:
    """The value of `reference.l1_ssim_loss`, a scalar, and its gradient by the image [H, W, C].

    Args:
        image: [H, W, C] floating point.
        target: [H, W, C] floating point, or uint8 (then 255 means 1).
        mask: [H, W] bool; None keeps all.
        ssim_weight: w in [0, 1].
    """
    x = masked(image, mask).permute(2, 0, 1)
    y = masked(unit_range(target, image.dtype), mask).permute(2, 0, 1)
    ssim, slope = _ssim_and_slope(x, y, mask)
    dissimilarity = 1 - ssim
    count: Tensor | int = max(image.numel(), 1)
    if mask is not None:
        dissimilarity *= mask
        count = (mask.sum() * image.shape[-1]).clamp(min=1)
    difference = x - y
    loss = (1 - ssim_weight) * difference.abs().sum() + ssim_weight * dissimilarity.sum()
    gradient = difference.sign_().mul_(1 - ssim_weight).sub_(slope, alpha=ssim_weight).div_(count)
    if mask is not None:
        gradient *= mask
    return loss / count, gradient.permute(1, 2, 0).contiguous()


def _ssim_and_slope(x: Tensor, y: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """SSIM of every pixel [C, H, W], and the gradient by `x` of its sum over the kept pixels."""
    mean_x, mean_y, xx, yy, xy = blurred(torch.stack((x, y, x * x, y * y, x * y)))
    # Rounded alike, so that the moments of equal images cancel alike.
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    # Halves of the factors of SSIM above the line, and those below it.
    a1, a2 = product + C1 / 2, (xy - product).add_(C2 / 2)
    b1, b2 = squares + C1, (xx + yy).sub_(squares).add_(C2)
    share = 4 / (b1 * b2)
    ssim = a1 * a2 * share
    # By the mean of x, where its variance and the covariance hold it too; by xx; by xy.
    by_mean = share * torch.addcmul(mean_y * (a2 - a1), mean_x * ssim, b1 - b2, value=0.5)
    slopes = torch.stack((by_mean, (ssim / b2).neg_(), a1 * share))
    if mask is not None:
        slopes *= mask
    of_mean, of_xx, of_xy = blurred(slopes)  # The window is symmetric: its adjoint is itself.
    return ssim, torch.addcmul(torch.addcmul(of_mean, x, of_xx, value=2), y, of_xy)
