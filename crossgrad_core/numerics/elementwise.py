"""Element-wise functions with the same bits on any number of threads.

torch shares long tensors out among its threads, and what is left over at the end of each share goes
through scalar code that rounds differently from the vectorised one. For the functions that the
vector library computes (exp, tanh) this makes no difference, for the sigmoid it does: a few
numbers then depend on the number of threads, and a whole training run with them.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

#: Elements that torch never shares out.
BLOCK = 2**14


def sigmoid(values: Tensor) -> Tensor:
    """1 / (1 + exp(-x)) of a floating-point tensor of any shape."""
    if _is_whole(values):
        return torch.sigmoid(values)
    found: Tensor = _Sigmoid.apply(values)  # type: ignore[no-untyped-call]
    return found


class _Sigmoid(torch.autograd.Function):
    """`sigmoid_` with a gradient, which needs no blocks: it has the same bits from all threads."""

    @staticmethod
    @override
    def forward(ctx: Any, values: Tensor) -> Tensor:
        found = sigmoid_(values.clone(memory_format=torch.contiguous_format))
        ctx.save_for_backward(found)
        return found

    @staticmethod
    @override
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        (found,) = ctx.saved_tensors
        gradient: Tensor = torch.ops.aten.sigmoid_backward(upstream, found)
        return gradient


def logsigmoid(values: Tensor) -> Tensor:
    """The logarithm of `sigmoid`, accurate where that is 0."""
    return _in_blocks(functional.logsigmoid, values)


def sigmoid_(values: Tensor) -> Tensor:
    """`sigmoid` in place, for a contiguous tensor without a gradient."""
    for part in torch.split(values.view(-1), BLOCK):
        part.sigmoid_()
    return values


def _is_whole(values: Tensor) -> bool:
    """Whether torch does not share it out among threads."""
    return values.numel() <= BLOCK or values.device.type != "cpu"


def _in_blocks(function: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    if _is_whole(values):
        return function(values)
    parts = [function(part) for part in torch.split(values.flatten(), BLOCK)]
    return torch.cat(parts).view_as(values)
