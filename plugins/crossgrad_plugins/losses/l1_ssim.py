"""The loss of 3DGS: absolute differences and structural dissimilarity."""

from typing import Any

import torch
from pydantic import Field
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

from crossgrad_core.plugin import Loss
from crossgrad_plugins.losses.photometric.reference import l1_ssim_loss, loss_and_gradient


def photometric_loss(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    ssim_weight: float = 0.2,
    weights: Tensor | None = None,
) -> Tensor:
    """Return (1 - w) * L1 + w * (1 - SSIM) over unmasked pixels; see `reference.l1_ssim_loss`.

    In float32, value and gradient are computed together: by a compiled kernel on the CPU, and by
    torch's operators on other devices. This gradient cannot be differentiated again. For other
    types, or with weights, plain torch operators are used, which can be differentiated again.

    Args:
        image: [H, W, 3] the render, floating point.
        target: [H, W, 3] the photo, floating point or uint8, on the device of the render.
        mask: [H, W] bool, True for pixels that count; None if all pixels count.
        ssim_weight: The weight w of the SSIM term, in [0, 1].
        weights: [H, W] non-negative weights of the pixels, floating point; None for equal weights.

    Returns:
        The loss, a scalar of the image's type.

    Raises:
        ValueError: The shapes do not match.
    """
    _check(image, target, mask)
    if weights is not None:
        _check_weights(image, weights)
        return l1_ssim_loss(image, target, mask, ssim_weight, weights)
    on_cpu = all(t is None or t.device.type == "cpu" for t in (image, target, mask))
    if image.dtype == torch.float32 and (on_cpu or image.requires_grad):
        way = _FusedLoss if on_cpu else _DeviceLoss
        loss: Tensor = way.apply(image, target, mask, ssim_weight)  # type: ignore[no-untyped-call]
        return loss
    return l1_ssim_loss(image, target, mask, ssim_weight)


class _FusedLoss(torch.autograd.Function):
    """Computes the gradient with respect to the image in the forward pass.

    The backward pass only scales this gradient.
    """

    @staticmethod
    @override
    def forward(
        ctx: Any, image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
    ) -> Tensor:
        from crossgrad_plugins.losses.photometric.numba_kernels.fused import loss_terms

        image = image.detach().contiguous()
        target = target.detach().contiguous()
        if target.dtype != torch.uint8:
            target = target.to(torch.float32)
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        absolute, dissimilarity = loss_terms(
            image.numpy(),
            target.numpy(),
            None if mask is None else mask.contiguous().numpy(),
            None if gradient is None else gradient.numpy(),
            ssim_weight,
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return image.new_tensor((1 - ssim_weight) * absolute + ssim_weight * dissimilarity)

    @staticmethod
    @once_differentiable
    @override
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        scaled = gradient if float(upstream) == 1.0 else gradient * upstream
        return scaled, None, None, None


class _DeviceLoss(torch.autograd.Function):
    """Like `_FusedLoss`, but with torch's operators on a GPU, without synchronisation."""

    @staticmethod
    @override
    def forward(
        ctx: Any, image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
    ) -> Tensor:
        loss, gradient = loss_and_gradient(image, target, mask, ssim_weight)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    @override
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None, None


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.ndim != 3 or image.shape[-1] != 3:  # noqa: PLR2004 - [H, W, 3]
        raise ValueError(f"`image` must be [H, W, 3]; found {list(image.shape)}")
    if target.shape != image.shape:
        shapes = f"{list(target.shape)} and {list(image.shape)}"
        raise ValueError(f"`target` must have the shape of `image`; found {shapes}")
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        description = f"{list(mask.shape)} {mask.dtype}"
        raise ValueError(f"`mask` must be [H, W] bool; found {description} for {list(image.shape)}")


def _check_weights(image: Tensor, weights: Tensor) -> None:
    if weights.shape != image.shape[:2] or not weights.is_floating_point():
        description = f"{list(weights.shape)} {weights.dtype}"
        message = f"`weights` must be [H, W] floats; found {description} for {list(image.shape)}"
        raise ValueError(message)


class L1SSIM(Loss):
    """(1 - w) * L1 + w * (1 - SSIM), where both terms are means over unmasked pixels and channels.

    In float32, value and gradient are computed together; on the CPU, a compiled kernel does this.
    With pixel weights or other types, torch's operators and autograd are used.

    Source: Kerbl et al. 2023 (3D Gaussian Splatting), eq. 7, with 1 - SSIM for D-SSIM.
    """

    ssim_weight: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss")

    @override
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        return photometric_loss(render, photo, mask, self.ssim_weight, weights)
