"""PSNR of 8-bit images.

Both images are clamped to [0, 1] and rounded to 8 bits first, as if the render had been written to
a file and read back. With a mask only kept pixels count.
"""

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.scene import to_uint8

#: PSNR of identical images, in dB. JSON has no infinity, and a mean over views must stay finite;
#: images that differ reach it only if fewer than one value in 150,000 is off, by one 8-bit step.
PSNR_LIMIT = 100.0
#: Pixels whose differences stay in the cache until they are summed.
_AT_ONCE = 2**15


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
    rendered, photo = (
        each.reshape(-1, 3) if mask is None else each[mask]
        for each in (to_uint8(image), to_uint8(target))
    )
    if rendered.numel() == 0:
        return None
    # All of these are whole numbers that float32 and float64 hold, in whatever order.
    total = 0.0
    for ours, theirs in zip(
        *(torch.split(each, _AT_ONCE) for each in (rendered, photo)), strict=True
    ):
        difference = ours.to(torch.float32) - theirs.to(torch.float32)
        total += float((difference * difference).sum(dtype=torch.float64))
    mean_square = total / rendered.numel() / 255**2
    return min(-10 * float(np.log10(mean_square)), PSNR_LIMIT) if mean_square > 0 else PSNR_LIMIT
