"""How inconsistent the directions of a Gaussian's pixels are, as a whole and beside each plane."""

import torch
from torch import Tensor

#: Candidate planes, across the longest axis at -2, -1, 0, 1, 2 standard deviations.
PLANES = 5


def inconsistency(sums: Tensor) -> Tensor:
    """[N] (1 - R) ga of pixels whose directions, absolute gradients and number are `sums`.

    R is the length of the mean direction, 1 where there is no pixel; ga is the norm of the absolute
    gradients. So nothing that pulls one way, or not at all, has any.

    Args:
        sums: [5, N] fields of `Screen.directions`, added up over bins.

    Source: DC4GS.
    """
    x, y, absolute_x, absolute_y, number = sums
    # No pixel: 1 - 0 / 1 times a ga of 0. Rounding can make the mean longer than unit vectors.
    rest = (1.0 - torch.sqrt(x * x + y * y) / number.clamp(min=1.0)).clamp(min=0.0)
    found: Tensor = rest * torch.sqrt(absolute_x * absolute_x + absolute_y * absolute_y)
    return found


def plane_scores(bins: Tensor) -> Tensor:
    """[5, N] mean of the inconsistencies on both sides of each plane.

    Args:
        bins: [6, 5, N] from `screen_statistics.directions`.
    """
    left, right = [bins[0]], [bins[-1]]
    for plane in range(1, PLANES):
        left.append(left[-1] + bins[plane])
        # From the other end: the whole less the left would leave roundings where there is nothing.
        right.append(right[-1] + bins[-1 - plane])
    sides = zip(left, reversed(right), strict=True)
    return torch.stack([(inconsistency(a) + inconsistency(b)) / 2.0 for a, b in sides])
