"""The way from features to Gaussians."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.fused_decode.data import Inputs, Kept
from crossgrad_backbones.anchors.numba_kernels import activation, layers
from crossgrad_backbones.anchors.panels import PANEL
from crossgrad_core.numerics.elementwise import sigmoid_
from crossgrad_core.numerics.jobs import parallel

#: Anchors of a stretch, a multiple of PANEL; fixed, so that sums do not depend on the machine.
STRETCH = 2048


def forward(inputs: Inputs) -> tuple[tuple[Tensor, ...], Kept]:
    """The G Gaussians of positive opacity, and what the backward pass needs.

    Returns:
        Means, quaternions, scales, opacities, colours, origin [G] and slot [G].
    """
    joined, hidden = _hidden(inputs)
    weight, bias = inputs.second[0]
    width = weight.shape[1]
    tanhs = torch.addmm(bias, hidden[: len(inputs.view.rows), :width], weight.T).tanh_()
    opacities = tanhs if inputs.view.factor is None else tanhs * inputs.view.factor[:, None]
    spreads = torch.exp(inputs.log_scales.index_select(0, inputs.view.rows))
    starts = np.empty(len(tanhs) + 1, np.int64)
    activation.count(array(opacities), starts)
    drawn = int(starts[-1])
    origin, slot = (torch.empty(drawn, dtype=torch.int64) for _ in range(2))
    widths = ((3,), (4,), (3,), (3,), (), (3,))
    means, quats, shares, scales, kept, colors = (torch.empty(drawn, *each) for each in widths)
    read = (opacities, inputs.view.positions, inputs.offsets, spreads, inputs.view.rows)
    written = (origin, slot, means, quats, shares, scales, kept, colors)
    _fill(inputs, hidden, (*map(array, read), starts, *map(array, written)))
    # The kernel gave raw numbers and the anchor's size: torch's sigmoid is vectorised.
    scales.mul_(sigmoid_(shares))
    sigmoid_(colors)
    remembered = (array(spreads), starts, array(slot), array(shares), array(colors))
    result = (means, quats, scales, kept, colors, origin, slot)
    return result, Kept(joined, hidden, tanhs, *remembered)


def stretches(anchors: int) -> list[slice]:
    """The anchors in stretches of fixed length."""
    return [slice(i, min(i + STRETCH, anchors)) for i in range(0, anchors, STRETCH)]


def array(tensor: Tensor) -> NDArray[Any]:
    """The tensor without its graph as an array in C order, without a copy where it is in order."""
    numbers: NDArray[Any] = tensor.detach().contiguous().numpy()
    return numbers


def _hidden(inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Inputs and rectified hidden layers, padded to a multiple of `PANEL`: no inputs are 0."""
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
    """Runs the second layers of covariance and colour and writes what is drawn."""
    (_, (cov, cov_bias), (color, color_bias)) = inputs.second
    width = cov.shape[1]
    for part in stretches(len(inputs.view.rows)):
        covariances = torch.addmm(cov_bias, hidden[part, width : 2 * width], cov.T)
        colors = torch.addmm(color_bias, hidden[part, 2 * width :], color.T)
        parallel(activation.gather, part.start, array(covariances), array(colors), *arrays)
