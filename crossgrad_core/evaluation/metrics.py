"""PSNR of 8-bit images.

Both images are clamped to [0, 1] and rounded to 8 bits first, as if the render had been written to
a file and read back. With a mask only kept pixels count.
"""

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.images import eight_bit

#: PSNR of identical images, in dB. JSON has no infinity, and a mean over views must stay finite;
#: images that differ reach it only if fewer than one value in 150,000 is off, by one 8-bit step.
PSNR_LIMIT = 100.0


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
    difference = eight_bit(image).to(torch.int64) - eight_bit(target).to(torch.int64)
    if mask is not None:
        difference = difference[mask]
    if difference.numel() == 0:
        return None
    mean_square = float((difference * difference).sum()) / difference.numel() / 255**2
    return min(-10 * float(np.log10(mean_square)), PSNR_LIMIT) if mean_square > 0 else PSNR_LIMIT
