"""The fused decoding as one differentiable operation."""

from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.fused_decode.backward import backward
from crossgrad_backbones.anchors.fused_decode.data import Inputs, View
from crossgrad_backbones.anchors.fused_decode.forward import forward
from crossgrad_core.plugin import Gaussians

#: What `forward` returns; the first five are differentiable.
_OUTPUTS = ("means", "quats", "scales", "opacities", "colors", "origin", "slot")
_DIFFERENTIABLE = 5


class _Decode(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, view: View, *tensors: Tensor) -> tuple[Tensor, ...]:
        result, ctx.kept = forward(Inputs.of(view, tensors))
        ctx.view = view
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(*result[_DIFFERENTIABLE:])
        ctx.set_materialize_grads(False)
        return result

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = Inputs.of(ctx.view, ctx.saved_tensors)
        return None, *backward(inputs, ctx.kept, gradients[:_DIFFERENTIABLE])


def gaussians_of(view: View, *tensors: Tensor) -> Gaussians:
    """The Gaussians of positive opacity, differentiable in all tensors.

    Args:
        view: The constant part.
        tensors: Features [Q, F], offsets [P, k, 3], log scales [P, 6], then weight and bias of the
            first layers and of the second layers of opacity, covariance and colour; float32.
    """
    result = _Decode.apply(view, *tensors)  # type: ignore[no-untyped-call]
    return Gaussians(**dict(zip(_OUTPUTS, result, strict=True)))
