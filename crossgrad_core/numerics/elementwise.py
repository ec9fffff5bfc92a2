"""Element-wise functions with the same bits on any number of threads.

torch divides long tensors among its threads. Scalar code processes the remainder of each part and
rounds differently from the vectorised code. For functions of the vector library (exp, tanh) the
results are equal. For the sigmoid, a few results differ. A whole training run would then depend on
the number of threads.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

#: Number of elements up to which torch never divides a tensor among threads.
BLOCK = 2**14


def sigmoid(values: Tensor) -> Tensor:
    """Return 1 / (1 + exp(-x)) of a floating-point tensor of any shape."""
    if _is_whole(values):
        return torch.sigmoid(values)
    result: Tensor = _Sigmoid.apply(values)  # type: ignore[no-untyped-call]
    return result


class _Sigmoid(torch.autograd.Function):
    """`sigmoid_` with a gradient, which has the same bits for any number of threads."""

    @staticmethod
    @override
    def forward(ctx: Any, values: Tensor) -> Tensor:
        result = sigmoid_(values.clone(memory_format=torch.contiguous_format))
        ctx.save_for_backward(result)
        return result

    @staticmethod
    @override
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        (result,) = ctx.saved_tensors
        gradient: Tensor = torch.ops.aten.sigmoid_backward(upstream, result)
        return gradient


def logsigmoid(values: Tensor) -> Tensor:
    """Return the logarithm of `sigmoid`, accurate even if `sigmoid` rounds to 0."""
    return _in_blocks(functional.logsigmoid, values)


def sigmoid_(values: Tensor) -> Tensor:
    """Compute `sigmoid` in place, for a contiguous tensor without a gradient."""
    for block in torch.split(values.view(-1), BLOCK):
        block.sigmoid_()
    return values


def _is_whole(values: Tensor) -> bool:
    """Return True if torch does not divide the tensor among threads."""
    return values.numel() <= BLOCK or values.device.type != "cpu"


def _in_blocks(function: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    if _is_whole(values):
        return function(values)
    parts = [function(block) for block in torch.split(values.flatten(), BLOCK)]
    return torch.cat(parts).view_as(values)
