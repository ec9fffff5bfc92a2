"""The networks that compute the Gaussians of visible anchors, in plain torch."""

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

#: Number of values of the direction from the camera to an anchor.
DIRECTION = 3
#: Indices of the two linear layers in a network. The ReLU between the linear layers has index 1.
LAYERS = (0, 2)
#: Strides with which the feature bank reads the feature vector, from coarse to fine.
BANK_STRIDES = (4, 2, 1)
#: Number of covariance values for each Gaussian: three scales, and a quaternion (w, x, y, z).
COVARIANCE = 7
_CHANNELS = 3
#: Number of rows that are summed together.
PANEL = 256


@dataclass(frozen=True)
class Network:
    """A network with one hidden layer: linear, ReLU, linear.

    Attributes:
        name: Name of the network and of its block. The tensors are `name.0.weight` [hidden,
            inputs], `name.0.bias`, `name.2.weight` [outputs, hidden] and `name.2.bias`.
        inputs: Number of inputs.
        hidden: Width of the hidden layer.
        outputs: Number of outputs.
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
        """Draw initial values as `torch.nn.Linear` does.

        The initial values are uniform in +-1 / sqrt(inputs of the layer).
        """
        tensors: Parameters = {}
        widths = ((self.inputs, self.hidden), (self.hidden, self.outputs))
        for layer, (width, out) in zip(LAYERS, widths, strict=True):
            bound = width**-0.5
            for kind, shape in (("weight", (out, width)), ("bias", (out,))):
                drawn = rng.uniform(-bound, bound, shape).astype(np.float32)
                tensors[f"{self.name}.{layer}.{kind}"] = torch.from_numpy(drawn)
        return tensors

    def layers(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return weight and bias of the first layer, then weight and bias of the second layer."""
        first, first_bias, second, second_bias = (parameters[name] for name in self.tensors)
        return first, first_bias, second, second_bias


@dataclass(frozen=True)
class Raw:
    """Raw outputs of the networks for A anchors with k Gaussians each, before the activations.

    Attributes:
        opacities: [A, k] raw opacities.
        covariances: [A, 7 k] raw values: three scales and a quaternion (w, x, y, z) for each
            Gaussian.
        colors: [A, 3 k] raw colours.
    """

    opacities: Tensor
    covariances: Tensor
    colors: Tensor


@dataclass(frozen=True)
class Heads:
    """The networks that compute an anchor's Gaussians from its feature vector and the direction.

    Attributes:
        offsets: Number k of Gaussians of each anchor.
        feature: Width F of the feature vectors and of the hidden layers.
        far: For opacity, covariance and colour: True if the network also receives the distance.
        code: Width of the appearance code that the colour network receives; 0 without a code.
        banked: True if a feature bank mixes the feature vector at three strides.
    """

    offsets: int
    feature: int
    far: tuple[bool, bool, bool]
    code: int
    banked: bool

    @cached_property
    def networks(self) -> tuple[Network, ...]:
        """The networks for opacity, covariance, colour and, if enabled, the feature bank."""
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
        # Avoid a division by zero if an anchor is exactly at the camera centre.
        direction = offset / distance.clamp(min=torch.finfo(offset.dtype).tiny)
        return torch.cat([direction, distance], 1)

    def inputs(self, views: Tensor) -> Tensor:
        """Return the columns [A, 3 or 4] of `views` that the three networks receive."""
        return views if any(self.far) else views[:, :DIRECTION]

    def mixed(self, parameters: Mapping[str, Tensor], features: Tensor, views: Tensor) -> Tensor:
        """Mix the feature vectors [A, F], read at strides 4, 2 and 1 and repeated to width F."""
        first, first_bias, second, second_bias = self.networks[-1].layers(parameters)
        hidden = linear(views, first, first_bias).relu()
        shares = torch.softmax(linear(hidden, second, second_bias), 1)
        width = features.shape[1]
        read = [features[:, ::stride].repeat(1, stride)[:, :width] for stride in BANK_STRIDES]
        return shares[:, :1] * read[0] + shares[:, 1:2] * read[1] + shares[:, 2:] * read[2]

    def first_layers(
        self, parameters: Mapping[str, Tensor], code: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the concatenated first layers: weights [3 H, F + 3 or 4] and biases [3 H].

        Args:
            parameters: The parameters.
            code: [C] appearance code; None without codes. The code is equal for all anchors, so
                that its effect is added to the bias.
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
        """Return weight and bias of the second layers for opacity, covariance and colour."""
        layers = [network.layers(parameters) for network in self.networks[:3]]
        return [(weight, bias) for _, _, weight, bias in layers]

    def raw(
        self,
        parameters: Mapping[str, Tensor],
        features: Tensor,
        views: Tensor,
        code: Tensor | None = None,
    ) -> Raw:
        """Compute the raw outputs of all networks.

        Args:
            parameters: The parameters, including the tensors of all networks.
            features: [A, F] feature vectors of the anchors.
            views: [A, 4] directions and distances, from `views`.
            code: [C] appearance code; None without codes.

        Source: Scaffold-GS, section 3.2.
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
    """The anchors that are decoded for a view.

    Attributes:
        rows: [A] int64 rows of the anchors, without duplicates.
        factor: [A] factor of each anchor's opacities, in [0, 1]; None if all factors are 1.
    """

    rows: Tensor
    factor: Tensor | None = None


def activated(
    raw: Raw, positions: Tensor, offsets: Tensor, log_scales: Tensor, seen: Seen
) -> Gaussians:
    """Return the Gaussians with positive opacity, in the order of anchors and slots.

    Gaussian j of anchor a has the mean x_a + offset_aj exp(l1_a) and the opacity tanh(raw). The
    scales of Gaussian j are exp(l2_a) sigmoid(raw), and its colour is sigmoid(raw). Quaternions are
    not normalised, because rasterizers accept any length.

    Args:
        raw: Raw outputs for A anchors with k Gaussians each.
        positions: [P, 3] positions x of all anchors.
        offsets: [P, k, 3] offsets of all anchors.
        log_scales: [P, 6] log scales of all anchors: three columns l1, then three columns l2.
        seen: The A anchors to which the raw outputs belong.

    Returns:
        Gaussians with `colors`, `origin` and `slot`.

    Source: Scaffold-GS, section 3.2.
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
    """Return the product [a, b] of `left` [n, a] transposed and `right` [n, b].

    The number n must be a multiple of `PANEL`.

    Each panel of `PANEL` rows is summed separately. A matrix library would split one long sum over
    all threads. The rounding of such a sum would depend on the number of threads.
    """
    first, second = (torch.unflatten(matrix, 0, (-1, PANEL)) for matrix in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0)


def panel_linear(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return inputs [n, a] times weight [b, a] transposed, plus bias [b].

    The result is differentiable once.
    """
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
