"""Images as losses and metrics take them: 8-bit and floating point, with masks."""

import torch
from torch import Tensor


def masked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image [H, W, C], 0 at masked-out pixels, so that not even a NaN leaks from them."""
    if mask is None:
        return image
    return torch.where(mask.unsqueeze(-1), image, image.new_zeros(()))


def unit_range(image: Tensor, dtype: torch.dtype) -> Tensor:
    """The image in `dtype`, 8-bit values divided by 255."""
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)


def to_uint8(image: Tensor) -> Tensor:
    """The image as uint8 on the CPU, clamped to [0, 1] and rounded; NaN becomes 0."""
    image = image.detach().cpu()
    if image.dtype == torch.uint8:
        return image
    return (torch.nan_to_num(image, nan=0.0).clamp(0, 1) * 255).round().to(torch.uint8)
