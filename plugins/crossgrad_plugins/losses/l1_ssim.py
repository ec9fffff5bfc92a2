"""The loss of 3DGS: absolute differences and dissimilar structure."""

from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Loss
from crossgrad_plugins.losses.photometric.loss import photometric_loss


class L1SSIM(Loss):
    """(1 - w) * L1 + w * (1 - SSIM), means over the pixels that count and their channels.

    In float32 value and gradient come from one pass, on the CPU a fused one; pixel weights and
    other types take torch's operators and autograd.

    Source: Kerbl et al. 2023 (3D Gaussian Splatting), eq. 7, with 1 - SSIM as D-SSIM.
    """

    ssim_weight: float = Field(0.2, ge=0, le=1, description="w, share of 1 - SSIM in the loss")

    @override
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        return photometric_loss(render, photo, mask, self.ssim_weight, weights)
