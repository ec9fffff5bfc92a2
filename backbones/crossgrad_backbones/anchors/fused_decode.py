"""Compute the networks and activations of the anchors in one differentiable function.

The function requires float32 on a CPU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.heads import PANEL
from crossgrad_backbones.anchors.numba_kernels import networks
from crossgrad_backbones.anchors.numba_kernels import networks as layers
from crossgrad_core.numerics.elementwise import sigmoid_
from crossgrad_core.numerics.jobs import parallel

#: Number of anchors in a stretch; a multiple of `PANEL`. The number is fixed, so that sums do not
#: depend on the number of threads.
STRETCH = 2048
#: Weight and bias of a linear layer.
Layer = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class View:
    """Constant inputs for the decoding of one view that sees A of P anchors.

    Attributes:
        positions: [P, 3] positions of all anchors.
        rows: [A] int64 rows of the anchors that the view sees, without duplicates.
        factor: [A] factor of each anchor's opacities; None if all factors are 1.
        views: [A, V] direction from the camera and, if used, distance.
        feature_rows: [A] int64 row of each anchor's feature, without duplicates.
    """

    positions: Tensor
    rows: Tensor
    factor: Tensor | None
    views: Tensor
    feature_rows: Tensor


@dataclass(frozen=True, eq=False)
class Inputs:
    """All inputs of the decoding; H is the width of a hidden layer.

    Attributes:
        view: The constant inputs.
        features: [Q, F] feature vectors.
        offsets: [P, k, 3] offsets of all anchors.
        log_scales: [P, 6] log scales of all anchors.
        first: [3 H, F + V] first layers of the three networks, concatenated.
        second: Second layers of opacity, covariance and colour.
    """

    view: View
    features: Tensor
    offsets: Tensor
    log_scales: Tensor
    first: Layer
    second: tuple[Layer, Layer, Layer]

    @classmethod
    def of(cls, view: View, tensors: Sequence[Tensor]) -> "Inputs":
        """Create the inputs from a view and all tensors.

        The tensors have the order of the attributes, and weights precede biases.
        """
        features, offsets, log_scales, *layers = tensors
        first, *second = zip(layers[::2], layers[1::2], strict=True)
        opacity, covariance, color = second
        return cls(view, features, offsets, log_scales, first, (opacity, covariance, color))


@dataclass(frozen=True, eq=False)
class Kept:
    """Values that the forward pass saves for the backward pass.

    G is the number of rendered Gaussians.

    Attributes:
        joined: [A or more, F + V] inputs of the networks, padded with rows of zeros.
        hidden: [A or more, 3 H] hidden layers after the ReLU.
        tanhs: [A, k] opacities before multiplication by the factor.
        spreads: [A, 6] exponentials of the log scales.
        starts: [A + 1] index of the first Gaussian of each anchor.
        slot: [G] slot of each Gaussian.
        shares: [G, 3] scales divided by the size of the anchor.
        colors: [G, 3] colours.
    """

    joined: Tensor
    hidden: Tensor
    tanhs: Tensor
    spreads: NDArray[np.float32]
    starts: NDArray[np.int64]
    slot: NDArray[np.int64]
    shares: NDArray[np.float32]
    colors: NDArray[np.float32]


def forward(inputs: Inputs) -> tuple[tuple[Tensor, ...], Kept]:
    """Compute the G Gaussians with positive opacity, and the values for the backward pass.

    Returns:
        Means, quaternions, scales, opacities, colours, origin [G] and slot [G], and the values for
        the backward pass.
    """
    joined, hidden = _hidden(inputs)
    weight, bias = inputs.second[0]
    width = weight.shape[1]
    tanhs = torch.addmm(bias, hidden[: len(inputs.view.rows), :width], weight.T).tanh_()
    opacities = tanhs if inputs.view.factor is None else tanhs * inputs.view.factor[:, None]
    spreads = torch.exp(inputs.log_scales.index_select(0, inputs.view.rows))
    starts = np.empty(len(tanhs) + 1, np.int64)
    networks.count(array(opacities), starts)
    drawn = int(starts[-1])
    origin, slot = (torch.empty(drawn, dtype=torch.int64) for _ in range(2))
    shapes = ((3,), (4,), (3,), (3,), (), (3,))
    means, quats, shares, scales, kept, colors = (torch.empty(drawn, *shape) for shape in shapes)
    read = (opacities, inputs.view.positions, inputs.offsets, spreads, inputs.view.rows)
    written = (origin, slot, means, quats, shares, scales, kept, colors)
    _fill(inputs, hidden, (*map(array, read), starts, *map(array, written)))
    # Apply the sigmoid here, because torch's sigmoid is vectorised. Before this line, `shares` and
    # `colors` contain values before the sigmoid, and `scales` contains the size of the anchor.
    scales.mul_(sigmoid_(shares))
    sigmoid_(colors)
    remembered = (array(spreads), starts, array(slot), array(shares), array(colors))
    result = (means, quats, scales, kept, colors, origin, slot)
    return result, Kept(joined, hidden, tanhs, *remembered)


def stretches(anchors: int) -> list[slice]:
    """Split the anchors into stretches of `STRETCH` anchors."""
    return [slice(i, min(i + STRETCH, anchors)) for i in range(0, anchors, STRETCH)]


def array(tensor: Tensor) -> NDArray[Any]:
    """Return the tensor as a C-order array without its autograd graph.

    Data are copied only if needed.
    """
    numbers: NDArray[Any] = tensor.detach().contiguous().numpy()
    return numbers


def _hidden(inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Return the inputs and hidden layers of the networks.

    Rows of zeros pad the inputs and the hidden layers to a multiple of `PANEL` rows.
    """
    weight, bias = inputs.first
    anchors = len(inputs.view.rows)
    joined = torch.empty(anchors + -anchors % PANEL, weight.shape[1])
    joined[anchors:] = 0.0
    features, rows, views = map(
        array, (inputs.features, inputs.view.feature_rows, inputs.view.views)
    )
    parallel(layers.join, features, rows, views, array(joined))
    return joined, torch.addmm(bias, joined, weight.T).relu_()


def _fill(inputs: Inputs, hidden: Tensor, arrays: tuple[NDArray[Any], ...]) -> None:
    """Compute the second layers of covariance and colour, and write the rendered Gaussians."""
    (_, (cov, cov_bias), (color, color_bias)) = inputs.second
    width = cov.shape[1]
    for stretch in stretches(len(inputs.view.rows)):
        covariances = torch.addmm(cov_bias, hidden[stretch, width : 2 * width], cov.T)
        colors = torch.addmm(color_bias, hidden[stretch, 2 * width :], color.T)
        parallel(networks.gather, stretch.start, array(covariances), array(colors), *arrays)
