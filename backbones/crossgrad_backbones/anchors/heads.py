"""The networks that give the Gaussians of the anchors that a camera sees, in plain torch."""

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

#: Width of the direction from the camera to the anchor.
DIRECTION = 3
#: Places of the two linear layers; the ReLU between them is number 1.
LAYERS = (0, 2)
#: Strides at which the feature bank reads the feature, from coarse to fine.
BANK_STRIDES = (4, 2, 1)
#: Numbers of a Gaussian's covariance: 3 scales and a quaternion wxyz.
COVARIANCE = 7
_CHANNELS = 3
#: Rows that are summed in one go.
PANEL = 256


@dataclass(frozen=True)
class Network:
    """A perceptron with one hidden layer and ReLU: Linear, ReLU, Linear.

    Attributes:
        name: Name of its block; its tensors are `name.0.weight` [hidden, inputs], `name.0.bias`,
            `name.2.weight` [outputs, hidden] and `name.2.bias`.
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
        """Names of its tensors."""
        return tuple(f"{self.name}.{n}.{kind}" for n in LAYERS for kind in ("weight", "bias"))

    def block(self, kind: BlockKind, lr: LearningRate) -> Block:
        """The block of all its tensors."""
        return Block(self.name, self.tensors, per_primitive=False, kind=kind, lr=lr)

    def created(self, rng: np.random.Generator) -> Parameters:
        """First values as those of `torch.nn.Linear`: uniform in +-1 / sqrt(inputs of a layer)."""
        tensors: Parameters = {}
        widths = ((self.inputs, self.hidden), (self.hidden, self.outputs))
        for layer, (width, out) in zip(LAYERS, widths, strict=True):
            bound = width**-0.5
            for kind, shape in (("weight", (out, width)), ("bias", (out,))):
                drawn = rng.uniform(-bound, bound, shape).astype(np.float32)
                tensors[f"{self.name}.{layer}.{kind}"] = torch.from_numpy(drawn)
        return tensors

    def layers(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weight and bias of the first layer, then of the second."""
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
    """The networks that turn an anchor's feature and the view of it into its Gaussians.

    Attributes:
        offsets: k, Gaussians of an anchor.
        feature: Width F of the feature and of the hidden layers.
        far: Whether the networks of opacity, covariance and colour take the distance too.
        code: Width of the appearance code, which the colour takes too; 0 without.
        banked: Whether a feature bank mixes the feature at three strides by direction and distance.
    """

    offsets: int
    feature: int
    far: tuple[bool, bool, bool]
    code: int
    banked: bool

    @cached_property
    def networks(self) -> tuple[Network, ...]:
        """Those of opacity, covariance and colour, then the feature bank's if there is one."""
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
        """[A, 4] direction and distance of anchors at `offset` [A, 3] from the camera."""
        distance = torch.linalg.vector_norm(offset, dim=1, keepdim=True)
        # An anchor in the very centre of the camera has no direction.
        direction = offset / distance.clamp(min=torch.finfo(offset.dtype).tiny)
        return torch.cat([direction, distance], 1)

    def inputs(self, views: Tensor) -> Tensor:
        """[A, 3 or 4] what of `views` the three networks take besides the feature."""
        return views if any(self.far) else views[:, :DIRECTION]

    def mixed(self, parameters: Mapping[str, Tensor], features: Tensor, views: Tensor) -> Tensor:
        """[A, F] features read at every fourth, second and first place (repeated to F), mixed."""
        first, first_bias, second, second_bias = self.networks[-1].layers(parameters)
        hidden = linear(views, first, first_bias).relu()
        shares = torch.softmax(linear(hidden, second, second_bias), 1)
        width = features.shape[1]
        read = [features[:, ::stride].repeat(1, stride)[:, :width] for stride in BANK_STRIDES]
        return shares[:, :1] * read[0] + shares[:, 1:2] * read[1] + shares[:, 2:] * read[2]

    def first_layers(
        self, parameters: Mapping[str, Tensor], code: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Weights [3 H, F + 3 or 4] and biases [3 H] of the first layers one after the other.

        Args:
            parameters: The parameters.
            code: [C] appearance code, or None: the same for all anchors, so a part of the bias.
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
        """Weight and bias of the second layers of opacity, covariance and colour."""
        layers = [network.layers(parameters) for network in self.networks[:3]]
        return [(weight, bias) for _, _, weight, bias in layers]

    def raw(
        self,
        parameters: Mapping[str, Tensor],
        features: Tensor,
        views: Tensor,
        code: Tensor | None = None,
    ) -> Raw:
        """Evaluates the networks.

        Args:
            parameters: The parameters, with the tensors of all networks.
            features: [A, F] of the anchors.
            views: [A, 4] from `views`.
            code: [C] appearance code; None without.

        Source: Scaffold-GS, section 3.2; methods of section 2.2.
        """
        if self.banked:
            features = self.mixed(parameters, features, views)
        inputs = torch.cat([features, self.inputs(views)], 1)
        hidden = linear(inputs, *self.first_layers(parameters, code)).relu_()
        parts = torch.split(hidden, self.feature, 1)
        layers = self.second_layers(parameters)
        return Raw(*(linear(part, *layer) for part, layer in zip(parts, layers, strict=True)))


@dataclass(frozen=True)
class Seen:
    """The anchors that a view decodes.

    Attributes:
        rows: [A] int64, their rows, each once.
        factor: [A] in [0, 1], what multiplies the opacities of each; None: 1.
    """

    rows: Tensor
    factor: Tensor | None = None


def activated(
    raw: Raw, positions: Tensor, offsets: Tensor, log_scales: Tensor, seen: Seen
) -> Gaussians:
    """The Gaussians whose opacity is positive, anchor by anchor, slot by slot.

    Gaussian j of anchor a has the mean x_a + offset_aj exp(l1_a), the opacity tanh(raw), the scales
    exp(l2_a) sigmoid(raw) and the colour sigmoid(raw). Quaternions keep their length, which no
    rasterizer depends on.

    Args:
        raw: Outputs for A anchors of k Gaussians.
        positions: [P, 3] of all anchors.
        offsets: [P, k, 3] of all anchors.
        log_scales: [P, 6] of all anchors: l1, then l2.
        seen: Which anchors the outputs are for.

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
    """[a, b] left [n, a] transposed times right [n, b], n a multiple of `PANEL`.

    Panel by panel: the libraries split one long sum over as many threads as there are, which would
    let the bits depend on their number.
    """
    first, second = (torch.unflatten(each, 0, (-1, PANEL)) for each in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0)


def panel_linear(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
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
