"""Image metrics of evaluation: PSNR and two kinds of SSIM on 8-bit images.

Every metric clamps both images to [0, 1] and rounds them to 8 bits first, as if the render had
been written to a file and read back. With a mask only kept pixels count; for both SSIMs a
masked-out pixel is 0 in both images.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.training.loss.reference import RADIUS, SIGMA, WINDOW, masked

#: PSNR of identical images, in dB. JSON has no infinity, and a mean over views must stay finite;
#: images that differ reach it only if fewer than one value in 150,000 is off, by one 8-bit step.
PSNR_LIMIT = 100.0

SSIM_SKIMAGE_TOO_SMALL = (
    f"scikit-image's SSIM needs kept pixels at least {RADIUS} pixels from the border, "
    f"in an image of {WINDOW} x {WINDOW} or more"
)


def quantise(image: Tensor) -> Tensor:
    """The image [H, W, 3] clamped to [0, 1] and rounded to multiples of 1/255; NaN becomes 0."""
    return _eight_bit(image).to(image.dtype) / 255


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Peak signal-to-noise ratio over all kept pixels and channels, in dB.

    Args:
        image: [H, W, 3] in [0, 1], or uint8.
        target: [H, W, 3] likewise.
        mask: [H, W] bool, True where the pixel counts; None keeps all.

    Returns:
        At most `PSNR_LIMIT`; None if no pixel is kept.

    Source: 3DGS evaluation script: 20 log10(1 / sqrt(MSE)).
    """
    difference = _eight_bit(image).to(torch.int64) - _eight_bit(target).to(torch.int64)
    if mask is not None:
        difference = difference[mask]
    if difference.numel() == 0:
        return None
    mean_square = float((difference * difference).sum()) / difference.numel() / 255**2
    return min(-10 * float(np.log10(mean_square)), PSNR_LIMIT) if mean_square > 0 else PSNR_LIMIT


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """SSIM as the loss has it: 11 x 11 Gaussian window, sigma 1.5, zero-padded.

    Arguments as for `psnr`. The mean over kept pixels; None if no pixel is kept.
    """
    from crossgrad_core.training.loss.numba_kernels.fused import loss_terms

    if _keeps_nothing(image, mask):
        return None
    rendered = (_eight_bit(image).to(torch.float32) / 255).contiguous().numpy()
    photo = _eight_bit(target).contiguous().numpy()
    kept = None if mask is None else mask.cpu().contiguous().numpy()
    return 1 - loss_terms(rendered, photo, kept)[1]


def ssim_skimage(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """SSIM of scikit-image with Gaussian weights, sigma 1.5, and without sample covariance.

    As in scikit-image, the mean leaves out a border of 5 pixels, where windows leave the image.

    Arguments as for `psnr`. None, with `SSIM_SKIMAGE_TOO_SMALL` as the reason, if nothing is left.
    """
    height, width = image.shape[:2]
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[RADIUS : height - RADIUS, RADIUS : width - RADIUS] = True
    if mask is not None:
        inside &= mask.cpu()
    if min(height, width) < WINDOW or not bool(inside.any()):
        return None
    return float(_skimage_map(image, target, mask)[inside.numpy()].mean())


def _skimage_map(image: Tensor, target: Tensor, mask: Tensor | None) -> NDArray[np.float64]:
    """SSIM per pixel and channel, [H, W, 3]."""
    from skimage.metrics import structural_similarity

    mask = None if mask is None else mask.cpu()
    rendered, photo = (
        masked(_eight_bit(i).to(torch.float64) / 255, mask).numpy() for i in (image, target)
    )
    _, full = structural_similarity(  # type: ignore[no-untyped-call]
        rendered,
        photo,
        gaussian_weights=True,
        sigma=SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    return np.asarray(full, dtype=np.float64)


def _eight_bit(image: Tensor) -> Tensor:
    """The image as uint8 on the CPU."""
    image = image.detach().cpu()
    if image.dtype == torch.uint8:
        return image
    return (torch.nan_to_num(image, nan=0.0).clamp(0, 1) * 255).round().to(torch.uint8)


def _keeps_nothing(image: Tensor, mask: Tensor | None) -> bool:
    return image.numel() == 0 if mask is None else not bool(mask.any())
