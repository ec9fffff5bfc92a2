"""The networks that compute the Gaussians of the anchors in view, in plain torch."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional
from torch.nn.functional import linear, pad
from typing_extensions import override

from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import Block, BlockKind, Gaussians, LearningRate, Parameters

#: Number of values of the direction from the camera to the anchor.
DIRECTION = 3
#: Indices of the two linear layers. The ReLU between them has index 1.
LAYERS = (0, 2)
#: Strides with which the feature bank reads the feature, from coarse to fine.
BANK_STRIDES = (4, 2, 1)
#: Number of covariance values per Gaussian: three for the scales, and four for the quaternion wxyz.
COVARIANCE = 7
_CHANNELS = 3
#: Number of rows that are summed at once.
PANEL = 256


@dataclass(frozen=True)
class Network:
    """A perceptron with one hidden layer and ReLU: Linear, ReLU, Linear.

    Attributes:
        name: Name of the network's block; its tensors are `name.0.weight` [hidden, inputs],
            `name.0.bias`, `name.2.weight` [outputs, hidden] and `name.2.bias`.
        inputs: Width of the input.
        hidden: Width of the hidden layer.
        outputs: Width of the output.
    """

    name: str
    inputs: int
    hidden: int
    outputs: int

    @property
    def tensors(self) -> tuple[str, ...]:
        """The names of the network's tensors."""
        return tuple(f"{self.name}.{n}.{kind}" for n in LAYERS for kind in ("weight", "bias"))

    def block(self, kind: BlockKind, lr: LearningRate) -> Block:
        """Return a block that contains all tensors of the network."""
        return Block(self.name, self.tensors, per_primitive=False, kind=kind, lr=lr)

    def created(self, rng: np.random.Generator) -> Parameters:
        """Draw initial values like `torch.nn.Linear`: uniform in +-1 / sqrt(inputs of a layer)."""
        tensors: Parameters = {}
        widths = ((self.inputs, self.hidden), (self.hidden, self.outputs))
        for layer, (width, out) in zip(LAYERS, widths, strict=True):
            bound = width**-0.5
            for kind, shape in (("weight", (out, width)), ("bias", (out,))):
                drawn = rng.uniform(-bound, bound, shape).astype(np.float32)
                tensors[f"{self.name}.{layer}.{kind}"] = torch.from_numpy(drawn)
        return tensors

    def layers(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return weight and bias of the first layer, then of the second layer."""
        first, first_bias, second, second_bias = (parameters[name] for name in self.tensors)
        return first, first_bias, second, second_bias


@dataclass(frozen=True)
class Raw:
    """Outputs of the networks for A anchors of k Gaussians each, before their activations.

    Attributes:
        opacities: [A, k].
        covariances: [A, 7 k], per Gaussian 3 scales and a quaternion wxyz.
        colors: [A, 3 k].
    """

    opacities: Tensor
    covariances: Tensor
    colors: Tensor


@dataclass(frozen=True)
class Heads:
    """The networks that compute an anchor's Gaussians from its feature and the viewing direction.

    Attributes:
        offsets: k, Gaussians of an anchor.
        feature: Width F of the feature and of the hidden layers.
        far: For opacity, covariance and colour: True if the network also uses the distance.
        code: Width of the appearance code, which the colour network also uses; 0 without a code.
        banked: True if a feature bank mixes the feature at three strides by direction and distance.
    """

    offsets: int
    feature: int
    far: tuple[bool, bool, bool]
    code: int
    banked: bool

    @cached_property
    def networks(self) -> tuple[Network, ...]:
        """The networks of opacity, covariance, colour and (if enabled) the feature bank."""
        outputs = (self.offsets, COVARIANCE * self.offsets, _CHANNELS * self.offsets)
        codes = (0, 0, self.code)
        three = tuple(
            Network(name, self.feature + DIRECTION + far + code, self.feature, width)
            for name, far, code, width in zip(
                ("mlp_opacity", "mlp_cov", "mlp_color"), self.far, codes, outputs, strict=True
            )
        )
        bank = Network("mlp_bank", DIRECTION + 1, self.feature, len(BANK_STRIDES))
        return (*three, bank) if self.banked else three

    def views(self, offset: Tensor) -> Tensor:
        """Return direction and distance [A, 4] of anchors at `offset` [A, 3] from the camera."""
        distance = torch.linalg.vector_norm(offset, dim=1, keepdim=True)
        # Avoid a division by zero: an anchor exactly at the camera centre has no direction.
        direction = offset / distance.clamp(min=torch.finfo(offset.dtype).tiny)
        return torch.cat([direction, distance], 1)

    def inputs(self, views: Tensor) -> Tensor:
        """Return the part [A, 3 or 4] of `views` that the three networks use with the feature."""
        return views if any(self.far) else views[:, :DIRECTION]

    def mixed(self, parameters: Mapping[str, Tensor], features: Tensor, views: Tensor) -> Tensor:
        """Mix the features [A, F], read at strides 4, 2 and 1 and repeated to F."""
        first, first_bias, second, second_bias = self.networks[-1].layers(parameters)
        hidden = linear(views, first, first_bias).relu()
        shares = torch.softmax(linear(hidden, second, second_bias), 1)
        width = features.shape[1]
        read = [features[:, ::stride].repeat(1, stride)[:, :width] for stride in BANK_STRIDES]
        return shares[:, :1] * read[0] + shares[:, 1:2] * read[1] + shares[:, 2:] * read[2]

    def first_layers(
        self, parameters: Mapping[str, Tensor], code: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the first layers, concatenated: weights [3 H, F + 3 or 4] and biases [3 H].

        Args:
            parameters: The parameters.
            code: [C] appearance code, or None. The code is the same for all anchors and is added to
                the bias.
        """
        weights, biases = [], []
        for network, far in zip(self.networks[:3], self.far, strict=True):
            weight, bias, _, _ = network.layers(parameters)
            if code is not None and network.name == "mlp_color":
                bias = torch.addmv(bias, weight[:, -self.code :], code)
                weight = weight[:, : -self.code]
            if any(self.far) and not far:
                weight = pad(weight, (0, 1))
            weights.append(weight)
            biases.append(bias)
        return torch.cat(weights), torch.cat(biases)

    def second_layers(self, parameters: Mapping[str, Tensor]) -> list[tuple[Tensor, Tensor]]:
        """Return weight and bias of the second layers of opacity, covariance and colour."""
        layers = [network.layers(parameters) for network in self.networks[:3]]
        return [(weight, bias) for _, _, weight, bias in layers]

    def raw(
        self,
        parameters: Mapping[str, Tensor],
        features: Tensor,
        views: Tensor,
        code: Tensor | None = None,
    ) -> Raw:
        """Evaluate the networks.

        Args:
            parameters: The parameters, with the tensors of all networks.
            features: [A, F] of the anchors.
            views: [A, 4] from `views`.
            code: [C] appearance code; None without a code.

        Source: Scaffold-GS, section 3.2; methods of section 2.2.
        """
        if self.banked:
            features = self.mixed(parameters, features, views)
        inputs = torch.cat([features, self.inputs(views)], 1)
        hidden = linear(inputs, *self.first_layers(parameters, code)).relu_()
        hidden_layers = torch.split(hidden, self.feature, 1)
        layers = self.second_layers(parameters)
        return Raw(
            *(
                linear(hidden_layer, *layer)
                for hidden_layer, layer in zip(hidden_layers, layers, strict=True)
            )
        )


@dataclass(frozen=True)
class Seen:
    """The anchors that are decoded for one view.

    Attributes:
        rows: [A] int64 rows of the anchors, without duplicates.
        factor: [A] in [0, 1], factor of the opacities of each anchor; None if all factors are 1.
    """

    rows: Tensor
    factor: Tensor | None = None


def activated(
    raw: Raw, positions: Tensor, offsets: Tensor, log_scales: Tensor, seen: Seen
) -> Gaussians:
    """Return the Gaussians with positive opacity, anchor by anchor, slot by slot.

    Gaussian j of anchor a has the mean x_a + offset_aj exp(l1_a), the opacity tanh(raw), the scales
    exp(l2_a) sigmoid(raw) and the colour sigmoid(raw). Quaternions are not normalised, because no
    rasterizer depends on their length.

    Args:
        raw: Outputs for A anchors of k Gaussians.
        positions: [P, 3] of all anchors.
        offsets: [P, k, 3] of all anchors.
        log_scales: [P, 6] of all anchors: l1, then l2.
        seen: The anchors of the outputs.

    Returns:
        Gaussians with `colors`, `origin` and `slot`.

    Source: Scaffold-GS, section 3.2; methods of section 2.2.
    """
    opacities = torch.tanh(raw.opacities)  # [A, k]
    if seen.factor is not None:
        opacities = opacities * seen.factor[:, None]
    anchor, slot = (opacities.detach() > 0).nonzero().unbind(1)
    origin = seen.rows[anchor]
    stretch, size = torch.split(torch.exp(log_scales[origin]), 3, 1)
    slots = opacities.shape[1]
    covariances = raw.covariances.view(-1, slots, COVARIANCE)[anchor, slot]
    colors = raw.colors.view(-1, slots, 3)[anchor, slot]
    return Gaussians(
        means=positions[origin] + offsets[origin, slot] * stretch,
        quats=covariances[:, 3:],
        scales=size * sigmoid(covariances[:, :3]),
        opacities=opacities[anchor, slot],
        colors=sigmoid(colors),
        origin=origin,
        slot=slot,
    )


def product(left: Tensor, right: Tensor) -> Tensor:
    """Return the product [a, b] of left [n, a] transposed and right [n, b]; n % `PANEL` is 0.

    The sum is computed panel by panel. Matrix libraries split one long sum over all threads, so the
    rounding of the sum depends on the number of threads.
    """
    first, second = (torch.unflatten(matrix, 0, (-1, PANEL)) for matrix in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0)


def panel_linear(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return inputs [n, a] times weight [b, a] transposed, plus bias [b]; differentiable once."""
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
        padded = (functional.pad(tensor, padding) for tensor in (given, inputs))
        return given @ weight, product(*padded), given.sum(0)
