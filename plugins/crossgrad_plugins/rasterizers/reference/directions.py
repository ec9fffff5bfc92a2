"""Directions of the pixels' gradients, binned along each Gaussian's longest axis."""

import torch
from torch import Tensor

#: Edges of the bins, standard deviations along the axis.
EDGES = (-2.0, -1.0, 0.0, 1.0, 2.0)
BINS, FIELDS = len(EDGES) + 1, 5
#: An axis that the camera sees shorter than this (pixels) is seen end on and has no direction.
SHORTEST = 1e-6


def longest_axes(factors: Tensor, scales: Tensor) -> Tensor:
    """[N, 2] a / |a|^2 with a the projection of each longest axis, px^-1; 0 where seen end on.

    Args:
        factors: [N, 2, 3] from `Projection`: the projections of the three axes.
        scales: [N, 3]; the first of equals counts as the largest.
    """
    longest = scales.argmax(-1)[:, None, None].expand(-1, 2, 1)
    axis = factors.gather(-1, longest).squeeze(-1)
    square = axis.square().sum(-1, keepdim=True)
    return torch.where(square > SHORTEST**2, axis / square, 0.0)


def binned_directions(
    gradients: Tensor, offsets: Tensor, axes: Tensor, size: tuple[int, int]
) -> Tensor:
    """[G, BINS, FIELDS] of `crossgrad_core.contract.gaussians.Screen.directions`, of some pixels.

    Args:
        gradients: [2, P, G] by the projected mean of each Gaussian, of each pixel.
        offsets: [2, P, G] pixel centre minus mean, pixels.
        axes: [G, 2] from `longest_axes`.
        size: Width and height of the image, pixels.
    """
    scaled = gradients * torch.tensor(size).to(gradients, non_blocking=True)[:, None, None]
    # Divided by the larger one first: their squares could be below the smallest number.
    largest = scaled.abs().amax(0)
    moved = largest > 0
    scaled = scaled / torch.where(moved, largest, 1.0)
    units = scaled / torch.where(moved, scaled.square().sum(0).sqrt(), 1.0)
    along = (offsets * axes.T[:, None, :]).sum(0)  # [P, G]
    edges = torch.tensor(EDGES).to(along, non_blocking=True)
    bins = torch.bucketize(along, edges, right=True)
    fields = torch.cat([units, gradients.abs(), moved[None].to(units)])  # [FIELDS, P, G]
    found = [torch.where(bins == number, fields, 0.0).sum(1) for number in range(BINS)]
    return torch.stack(found).permute(2, 0, 1)
