"""Decode anchors to the Gaussians that a camera sees."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.fused_decode import (
    STRETCH,
    Inputs,
    Kept,
    Layer,
    View,
    array,
    forward,
    stretches,
)
from crossgrad_backbones.anchors.heads import Heads, Seen, activated, product
from crossgrad_backbones.anchors.numba_kernels import networks
from crossgrad_backbones.anchors.numba_kernels import networks as layers
from crossgrad_core.numerics.jobs import parallel
from crossgrad_core.plugin import Camera, Gaussians

Gradients: TypeAlias = tuple[Tensor | None, ...]
#: Indices of the three output networks (opacity, covariance, colour), and index of the covariance
#: network.
_HEADS, _COVARIANCE = (0, 1, 2), 1
#: Position of the scales in the list of means, quaternions, scales, opacities and colours.
_SCALES = 2


@dataclass(frozen=True, eq=False)
class _Back:
    """Sums of gradients over all anchors, and buffers for one stretch (a fixed number of anchors).

    Attributes:
        heads: Indices of the output networks that receive a gradient. The indices of these heads
            are consecutive.
        features: [Q, F] sum of gradients with respect to the features.
        first: Sums of gradients with respect to the first layers.
        second: Sums of gradients with respect to the second layers of `heads`, concatenated.
        raw: [n, outputs of all heads] gradients with respect to the raw outputs of n anchors.
        hidden: [n, H of all heads] gradients with respect to the hidden layers of n anchors.
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
        """Process all anchors in stretches. `fill(first, n)` writes `raw` for n anchors."""
        width, feature = self.second[0].shape[1], inputs.features.shape[1]
        begin = self.heads[0] * width
        mine = slice(begin, begin + self.hidden.shape[1])
        weight = inputs.first[0][mine, :feature]
        whole, buffer = array(kept.hidden), array(self.hidden)
        anchors = len(kept.tanhs)
        for stretch in stretches(len(kept.hidden)):
            rows, count = stretch.stop - stretch.start, min(stretch.stop, anchors) - stretch.start
            fill(stretch.start, count)
            self.raw[count:rows] = 0.0
            hidden = self.hidden[:rows]
            self._second(inputs, kept.hidden[stretch, mine], self.raw[:rows], hidden)
            parallel(layers.rectify_back, stretch.start, rows, begin, whole, buffer)
            self.first[0][mine] += product(hidden, kept.joined[stretch])
            self.first[1][mine] += hidden.sum(0)
            owners = inputs.view.feature_rows[stretch]
            self.features.index_copy_(0, owners, hidden[:count] @ weight)

    def _second(self, inputs: Inputs, hidden: Tensor, raw: Tensor, out: Tensor) -> None:
        """Compute the gradients with respect to the hidden layers and the second layers."""
        width, at = self.second[0].shape[1], 0
        for index, head in enumerate(self.heads):
            weight = inputs.second[head][0]
            outputs = slice(at, at + len(weight))
            columns = slice(index * width, (index + 1) * width)
            self.second[0][outputs] += product(raw[:, outputs], hidden[:, columns])
            torch.mm(raw[:, outputs], weight, out=out[:, columns])
            at = outputs.stop
        self.second[1].add_(raw.sum(0))

    def by_second(self, inputs: Inputs) -> list[Tensor | None]:
        """Return gradients of weights and biases of the three second layers.

        An output network without a gradient gets None.
        """
        gradients: list[Tensor | None] = [None] * (2 * len(_HEADS))
        sizes = [len(inputs.second[head][1]) for head in self.heads]
        weights, biases = (torch.split(gradient, sizes) for gradient in self.second)
        for head, weight, bias in zip(self.heads, weights, biases, strict=True):
            gradients[2 * head : 2 * head + 2] = weight, bias
        return gradients


def backward(inputs: Inputs, kept: Kept, given: Gradients) -> Gradients:
    """Compute the gradients with respect to the inputs of the forward pass.

    Args:
        inputs: The inputs of the forward pass.
        kept: The values that the forward pass saved.
        given: Gradients with respect to means, quaternions, scales, opacities and colours; None
            means zero.

    Returns:
        Gradients with respect to features, offsets, log scales, weight and bias of the first
        layers, and weight and bias of each second layer. If only the scales have a gradient (volume
        regularization), the gradients of the offsets, the opacity network and the colour network
        are None. These gradients are not computed, which saves time.
    """
    alone = all((gradient is not None) == (i == _SCALES) for i, gradient in enumerate(given))
    back = _Back.of(inputs, kept, (_COVARIANCE,) if alone else _HEADS)
    by_log_scales = torch.zeros_like(inputs.log_scales)
    by_offsets = None if alone else torch.zeros_like(inputs.offsets)
    means, quats, scales, opacities, colors = _filled(given, kept)
    rows = array(inputs.view.rows)
    shared = (rows, kept.starts, kept.slot, kept.spreads, kept.shares, scales)
    arrays = (*shared, array(by_log_scales), array(back.raw))
    if by_offsets is None:
        fill = partial(_call, networks.scatter_scales, arrays)
    else:
        factor = inputs.view.factor
        factors = torch.ones(len(rows)) if factor is None else factor
        read = (array(kept.tanhs), array(factors), array(inputs.offsets), kept.colors)
        more = (*read, means, quats, opacities, colors, array(by_offsets))
        fill = partial(_call, networks.scatter, (*arrays, *more))
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


#: Names of the outputs of `forward`. Only the first five outputs are differentiable.
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
    """Return the Gaussians with positive opacity.

    The Gaussians are differentiable with respect to all tensors.

    Args:
        view: The constant inputs.
        tensors: Features [Q, F], offsets [P, k, 3], log scales [P, 6], then weights and biases, all
            float32. The weights and biases belong to the first layers, and to the second layers of
            opacity, covariance and colour.
    """
    result = _Decode.apply(view, *tensors)  # type: ignore[no-untyped-call]
    return Gaussians(**dict(zip(_OUTPUTS, result, strict=True)))


def decoded(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    camera: Camera,
    seen: Seen,
    code: Tensor | None = None,
) -> Gaussians:
    """Decode the given anchors to Gaussians for a camera. The result is differentiable.

    Args:
        heads: The networks of the anchors.
        parameters: `anchors` [P, 3], `offsets` [P, k, 3], `features` [P, F], `scales` [P, 6]
            (logarithms), and the tensors of the networks.
        camera: The camera.
        seen: The anchors to decode, with the factors of their opacities.
        code: [C] appearance code; None without codes.

    Returns:
        Gaussians with `colors`, `origin`, `slot` and `decoded`. Gaussians whose opacity is not
        positive are left out.
    """
    positions = parameters["anchors"]
    eye = camera.center.to(positions, non_blocking=True)
    views = heads.views(positions.index_select(0, seen.rows) - eye)
    decode = _fused if _fusible(parameters) else _plain
    gaussians = decode(heads, parameters, seen, views, code)
    mask = torch.zeros(positions.shape[0], dtype=torch.bool, device=positions.device)
    return replace(gaussians, decoded=mask.index_fill_(0, seen.rows, value=True))


def _fusible(parameters: Mapping[str, Tensor]) -> bool:
    """Return True if fused decoding is possible.

    Fused decoding requires float32 on the CPU and fixed anchors.
    """
    names = ("anchors", "offsets", "features", "scales")
    tensors = [parameters[name] for name in names]
    plain = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)
    return plain and not parameters["anchors"].requires_grad


def _plain(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    seen: Seen,
    views: Tensor,
    code: Tensor | None,
) -> Gaussians:
    features = parameters["features"].index_select(0, seen.rows)
    raw = heads.raw(parameters, features, views, code)
    positions, offsets, scales = (parameters[name] for name in ("anchors", "offsets", "scales"))
    return activated(raw, positions, offsets, scales, seen)


def _fused(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    seen: Seen,
    views: Tensor,
    code: Tensor | None,
) -> Gaussians:
    features, rows = parameters["features"], seen.rows
    if heads.banked:
        features = heads.mixed(parameters, features.index_select(0, rows), views)
        rows = torch.arange(len(rows))
    view = View(parameters["anchors"], seen.rows, seen.factor, heads.inputs(views), rows)
    layers = [heads.first_layers(parameters, code), *heads.second_layers(parameters)]
    tensors = (features, parameters["offsets"], parameters["scales"])
    return gaussians_of(view, *tensors, *(tensor for layer in layers for tensor in layer))
