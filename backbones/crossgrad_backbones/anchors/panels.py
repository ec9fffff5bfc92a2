"""Sums over many anchors whose bits do not depend on the number of threads."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional
from typing_extensions import override

#: Rows that are summed in one go.
PANEL = 256


def product(left: Tensor, right: Tensor) -> Tensor:
    """[a, b] left [n, a] transposed times right [n, b], n a multiple of `PANEL`.

    Panel by panel: the libraries split one long sum over as many threads as there are, which would
    let the bits depend on their number.
    """
    first, second = (torch.unflatten(each, 0, (-1, PANEL)) for each in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0)


def linear(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """[n, b] inputs [n, a] times weight [b, a] transposed, plus bias [b]; differentiable once."""
    outputs: Tensor = _Linear.apply(inputs, weight, bias)  # type: ignore[no-untyped-call]
    return outputs


class _Linear(Function):
    @staticmethod
    @override
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        return functional.linear(inputs, weight, bias)

    @staticmethod
    @override
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        inputs, weight = ctx.saved_tensors
        padding = (0, 0, 0, -len(inputs) % PANEL)
        padded = (functional.pad(each, padding) for each in (given, inputs))
        return given @ weight, product(*padded), given.sum(0)
