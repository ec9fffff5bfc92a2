"""The small networks of the anchors: their tensors, blocks and first values."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.plugin import Block, BlockKind, LearningRate, Parameters

#: Width of the direction from the camera to the anchor.
DIRECTION = 3
#: Places of the two linear layers; the ReLU between them is number 1.
LAYERS = (0, 2)


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
