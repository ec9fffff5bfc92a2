"""Element-wise functions whose results are bit-identical for any number of threads.

torch divides long tensors into parts, one for each thread. In each part, the last elements are
computed by scalar code, which may round differently from vectorised code. For exp and tanh, scalar
and vectorised code give equal results. For the sigmoid, a few results differ. With torch's sigmoid,
the result of a training run would therefore depend on the number of threads.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

#: torch never divides a tensor of at most this number of elements among threads.
BLOCK = 2**14


def sigmoid(values: Tensor) -> Tensor:
    """Return 1 / (1 + exp(-x)) for each element of a floating-point tensor."""
    if _is_whole(values):
        return torch.sigmoid(values)
    result: Tensor = _Sigmoid.apply(values)  # type: ignore[no-untyped-call]
    return result


class _Sigmoid(torch.autograd.Function):
    """The sigmoid with its gradient.

    The sigmoid and its gradient are bit-identical for any number of threads.
    """

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
    """Return the logarithm of the sigmoid.

    The logarithm is accurate even if the sigmoid rounds to 0.
    """
    return _in_blocks(functional.logsigmoid, values)


def sigmoid_(values: Tensor) -> Tensor:
    """Compute the sigmoid in place, for a contiguous tensor that requires no gradient."""
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
