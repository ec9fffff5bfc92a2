"""A smooth absolute difference as the photometric loss."""

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Field, Loss, unit_range


class Charbonnier(Loss):
    """Mean of sqrt(d^2 + e^2) - e over the pixels that count, with the difference d."""

    epsilon: float = Field(0.01, gt=0, description="error below which the loss is quadratic")

    @override
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        difference = render - unit_range(photo, render.dtype)
        each = torch.sqrt(difference.square() + self.epsilon**2) - self.epsilon
        share = torch.ones_like(render[..., 0]) if weights is None else weights
        if mask is not None:
            share = torch.where(mask, share, 0.0)
            each = torch.where(mask[..., None], each, 0.0)
        total = share.sum()
        return (each.mean(-1) * share).sum() / torch.where(total > 0, total, 1.0)
