"""Arguments of the fused decoding, and the values kept for its backward pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

#: Weight and bias of a linear layer.
Layer = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class View:
    """Constants in the decoding of a view; A of P anchors are seen.

    Attributes:
        positions: [P, 3].
        rows: [A] int64, the anchors that are seen, each once.
        factor: [A] what multiplies their opacities; None: 1.
        views: [A, V] direction (and distance) from the camera.
        feature_rows: [A] int64, the row of each anchor's feature, each once.
    """

    positions: Tensor
    rows: Tensor
    factor: Tensor | None
    views: Tensor
    feature_rows: Tensor


@dataclass(frozen=True, eq=False)
class Inputs:
    """A view, and what the Gaussians are differentiable in; H is the width of a hidden layer.

    Attributes:
        view: The constant part.
        features: [Q, F].
        offsets: [P, k, 3].
        log_scales: [P, 6].
        first: [3 H, F + V] the first layers one after the other.
        second: The second layers of opacity, covariance and colour.
    """

    view: View
    features: Tensor
    offsets: Tensor
    log_scales: Tensor
    first: Layer
    second: tuple[Layer, Layer, Layer]

    @classmethod
    def of(cls, view: View, tensors: Sequence[Tensor]) -> "Inputs":
        """From a view and all tensors in the order of the attributes, weights before biases."""
        features, offsets, log_scales, *layers = tensors
        first, *second = zip(layers[::2], layers[1::2], strict=True)
        opacity, covariance, color = second
        return cls(view, features, offsets, log_scales, first, (opacity, covariance, color))


@dataclass(frozen=True, eq=False)
class Kept:
    """Values kept for the backward pass besides the inputs; G Gaussians are drawn.

    Attributes:
        joined: [A or more, F + V] inputs of the networks, padded with rows of 0.
        hidden: [A or more, 3 H] rectified hidden layers.
        tanhs: [A, k] opacities before the factor.
        spreads: [A, 6] exponentials of the log scales.
        starts: [A + 1] first Gaussian of each anchor.
        slot: [G].
        shares: [G, 3] scales divided by the anchor's size.
        colors: [G, 3].
    """

    joined: Tensor
    hidden: Tensor
    tanhs: Tensor
    spreads: NDArray[np.float32]
    starts: NDArray[np.int64]
    slot: NDArray[np.int64]
    shares: NDArray[np.float32]
    colors: NDArray[np.float32]
