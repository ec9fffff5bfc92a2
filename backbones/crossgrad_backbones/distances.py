"""How far cameras are from their mean, on a logarithmic scale, and weights on that distance."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera

#: Distances are at least this, local units: the mean itself has no logarithm.
NEAREST = 1e-3
#: Where the logarithms of all distances differ by less than this (standard deviation), the
#: distances are taken as equal.
LEAST_SPREAD = 1e-6


@dataclass(frozen=True)
class Conditioned:
    """A tensor of vanilla that depends on the distance.

    Attributes:
        weights: Name of its weights [N, ..., 2].
        base: The block that they add to.
        shape: Shape of a primitive's weights; the product with D broadcasts to that of the base.
    """

    weights: str
    base: str
    shape: tuple[int, ...]


SCALES = Conditioned("distance_scales", "scales", (1, 2))
OPACITIES = Conditioned("distance_opacities", "opacities", (2,))
COLORS = Conditioned("distance_f_dc", "f_dc", (1, 3, 2))


def fitted_scale(cameras: Sequence[Camera]) -> Tensor:
    """[7] float64: mean centre, mean and 1 / standard deviation of log r, least and largest z.

    The last three are 0 where there is one camera, or all distances are equal.
    """
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.mean(0)
    logs = _log_distances(centers, middle)
    spread = logs.std(unbiased=False)
    inverse = 1.0 / spread if float(spread) > LEAST_SPREAD else torch.zeros_like(spread)
    z = (logs - logs.mean()) * inverse
    return torch.cat([middle, torch.stack([logs.mean(), inverse, z.min(), z.max()])])


def told_apart(scale: Tensor) -> bool:
    """Whether distances differ on a scale of `fitted_scale`."""
    return bool(scale[4] > 0)


def encoded(scale: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """[2] the encoding D = (z, z^2), the mean over the cameras.

    z is the standardised log r of a camera, kept in the range of the training cameras: outside it
    a quadratic says nothing.
    """
    centers = torch.stack([camera.center for camera in cameras]).to(scale, non_blocking=True)
    z = (_log_distances(centers, scale[:3]) - scale[3]) * scale[4]
    z = torch.minimum(torch.maximum(z, scale[5]), scale[6])
    return torch.stack([z.mean(), z.square().mean()])


def added(weights: Tensor, encoding: Tensor) -> Tensor:
    """[N, ...] what weights [N, ..., 2] add at an encoding [2].

    No matrix product: its rounding depends on the number of threads.
    """
    products: Tensor = weights * encoding
    return products.sum(-1)


def largest_addition(scale: Tensor, weights: Tensor) -> Tensor:
    """[N] the most that weights [N, 2] add, w_1 z + w_2 z^2, within the range of z."""
    first, second = weights.unbind(1)
    least, most = scale[5:].to(weights)
    # A parabola is largest at an end of the range, or at its vertex where it opens downwards.
    vertex = torch.where(second < 0, -first / (2 * second), least)
    vertex = torch.minimum(torch.maximum(vertex, least), most)
    sums: Tensor = torch.stack([z * first + z * z * second for z in (least, vertex, most)])
    return sums.amax(0)


def penalty(weights: Tensor, l2: float, smoothness: float) -> Tensor:
    """Penalty on weights [N, ..., 2]: sums over the weights of a Gaussian, mean over Gaussians.

    `l2` times the squares, and `smoothness` times the squared derivative of w_1 z + w_2 z^2 by z,
    the mean over the training cameras. There z has mean 0 and variance 1, so that the mean of
    (w_1 + 2 w_2 z)^2 is w_1^2 + 4 w_2^2.
    """
    factors = torch.tensor([l2 + smoothness, l2 + 4 * smoothness]).to(weights, non_blocking=True)
    total: Tensor = (weights.square() @ factors).sum()
    return total / max(1, len(weights))


def _log_distances(centers: Tensor, middle: Tensor) -> Tensor:
    distances: Tensor = torch.linalg.vector_norm(centers - middle, dim=1)
    return distances.clamp(min=NEAREST).log()
