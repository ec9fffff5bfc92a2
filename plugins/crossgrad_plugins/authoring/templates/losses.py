"""How far a render is from its photo."""

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Loss


class Template(Loss):
    """Mean absolute difference of the pixels that count."""

    @override
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        target = photo.to(render) / (255.0 if photo.dtype == torch.uint8 else 1.0)
        error = (render - target).abs().mean(dim=2)  # [H, W]
        counted = torch.ones_like(error) if weights is None else weights.to(error)
        if mask is not None:
            nothing = torch.zeros_like(error)
            error, counted = torch.where(mask, error, nothing), torch.where(mask, counted, nothing)
        return (error * counted).sum() / counted.sum().clamp(min=torch.finfo(error.dtype).tiny)
