"""The backward pass from the gradients of the Gaussians to those of features and networks."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.fused_decode.data import Inputs, Kept, Layer
from crossgrad_backbones.anchors.fused_decode.forward import STRETCH, array, stretches
from crossgrad_backbones.anchors.numba_kernels import activation, layers
from crossgrad_backbones.anchors.panels import product
from crossgrad_core.numerics.jobs import parallel

Gradients: TypeAlias = tuple[Tensor | None, ...]

#: Opacity, covariance and colour, and the place of the covariance among them.
_HEADS, _COVARIANCE = (0, 1, 2), 1
#: Place of the scales among means, quaternions, scales, opacities and colours.
_SCALES = 2


@dataclass(frozen=True, eq=False)
class _Back:
    """Sums over the anchors, and memory for a stretch of them.

    Attributes:
        heads: Which of opacity, covariance and colour have a gradient, without gaps.
        features: [Q, F] sum.
        first: Sums of the first layers.
        second: Sums of the second layers of `heads`, one after the other.
        raw: [n, outputs of all heads] gradient by the raw outputs.
        hidden: [n, H of all heads] gradient by the hidden layers.
    """

    heads: tuple[int, ...]
    features: Tensor
    first: Layer
    second: Layer
    raw: Tensor
    hidden: Tensor

    @classmethod
    def of(cls, inputs: Inputs, kept: Kept, heads: tuple[int, ...]) -> "_Back":
        count = min(STRETCH, len(kept.hidden))
        outputs = sum(len(inputs.second[head][1]) for head in heads)
        width = inputs.second[0][0].shape[1]
        first = (torch.zeros_like(inputs.first[0]), torch.zeros_like(inputs.first[1]))
        second = (torch.zeros(outputs, width), torch.zeros(outputs))
        buffers = (torch.empty(count, outputs), torch.empty(count, len(heads) * width))
        return cls(heads, torch.zeros_like(inputs.features), first, second, *buffers)

    def sweep(self, inputs: Inputs, kept: Kept, fill: Callable[..., None]) -> None:
        """Goes through all anchors; `fill(first, n)` writes `raw`."""
        width, feature = self.second[0].shape[1], inputs.features.shape[1]
        begin = self.heads[0] * width
        mine = slice(begin, begin + self.hidden.shape[1])
        weight = inputs.first[0][mine, :feature]
        whole, buffer = array(kept.hidden), array(self.hidden)
        anchors = len(kept.tanhs)
        for part in stretches(len(kept.hidden)):
            rows, count = part.stop - part.start, min(part.stop, anchors) - part.start
            fill(part.start, count)
            self.raw[count:rows] = 0.0
            hidden = self.hidden[:rows]
            self._second(inputs, kept.hidden[part, mine], self.raw[:rows], hidden)
            parallel(layers.rectify_back, part.start, rows, begin, whole, buffer)
            self.first[0][mine] += product(hidden, kept.joined[part])
            self.first[1][mine] += hidden.sum(0)
            owners = inputs.view.feature_rows[part]
            self.features.index_copy_(0, owners, hidden[:count] @ weight)

    def _second(self, inputs: Inputs, hidden: Tensor, raw: Tensor, out: Tensor) -> None:
        """Gradient [n, H of all heads] by the rectified layers, and by the second layers."""
        width, at = self.second[0].shape[1], 0
        for place, head in enumerate(self.heads):
            weight = inputs.second[head][0]
            outputs = slice(at, at + len(weight))
            columns = slice(place * width, (place + 1) * width)
            self.second[0][outputs] += product(raw[:, outputs], hidden[:, columns])
            torch.mm(raw[:, outputs], weight, out=out[:, columns])
            at = outputs.stop
        self.second[1].add_(raw.sum(0))

    def by_second(self, inputs: Inputs) -> list[Tensor | None]:
        """Gradients of weight and bias of the three second layers, None for heads without."""
        found: list[Tensor | None] = [None] * (2 * len(_HEADS))
        sizes = [len(inputs.second[head][1]) for head in self.heads]
        weights, biases = (torch.split(each, sizes) for each in self.second)
        for head, weight, bias in zip(self.heads, weights, biases, strict=True):
            found[2 * head : 2 * head + 2] = weight, bias
        return found


def backward(inputs: Inputs, kept: Kept, given: Gradients) -> Gradients:
    """Gradients of the inputs.

    Args:
        inputs: What the way there took.
        kept: What it kept.
        given: Gradients by means, quaternions, scales, opacities and colours; None is zero.

    Returns:
        Gradients by features, offsets, log scales, weight and bias of the first layers, and of each
        second layer. Where only the scales have a gradient (volume regularisation), those of the
        offsets and of the other two networks are None and cost nothing.
    """
    alone = all((each is not None) == (i == _SCALES) for i, each in enumerate(given))
    back = _Back.of(inputs, kept, (_COVARIANCE,) if alone else _HEADS)
    by_log_scales = torch.zeros_like(inputs.log_scales)
    by_offsets = None if alone else torch.zeros_like(inputs.offsets)
    means, quats, scales, opacities, colors = _filled(given, kept)
    rows = array(inputs.view.rows)
    shared = (rows, kept.starts, kept.slot, kept.spreads, kept.shares, scales)
    arrays = (*shared, array(by_log_scales), array(back.raw))
    if by_offsets is None:
        fill = partial(_call, activation.scatter_scales, arrays)
    else:
        factor = inputs.view.factor
        factors = torch.ones(len(rows)) if factor is None else factor
        read = (array(kept.tanhs), array(factors), array(inputs.offsets), kept.colors)
        more = (*read, means, quats, opacities, colors, array(by_offsets))
        fill = partial(_call, activation.scatter, (*arrays, *more))
    back.sweep(inputs, kept, fill)
    return (back.features, by_offsets, by_log_scales, *back.first, *back.by_second(inputs))


def _call(kernel: Callable[..., None], arrays: tuple[Any, ...], first: int, count: int) -> None:
    parallel(kernel, first, count, *arrays)


def _filled(given: Gradients, kept: Kept) -> list[NDArray[Any]]:
    gaussians = len(kept.slot)
    widths = ((3,), (4,), (3,), (), (3,))
    return [
        array(torch.zeros(gaussians, *width) if gradient is None else gradient)
        for gradient, width in zip(given, widths, strict=True)
    ]
