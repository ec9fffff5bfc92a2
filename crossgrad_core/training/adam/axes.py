"""Steps of positions in the units of their Gaussians: along each axis by a share of its length.

Adam gives every position steps of one length, whatever is drawn there: a Gaussian of a wall that a
camera stands before jumps over its neighbours while one of the ground below a drone hardly moves.
Scenes that are photographed from very different distances have both (docs/schedules.md).
"""

from math import inf, log, nan
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.columns import is_native
from crossgrad_core.numerics.rotations import rotation_matrices

#: An axis counts as so many times shorter or longer than the usual one, at most.
LIMIT: Final = 5.0
#: Gaussians that are looked at to find the usual one, at most.
_SAMPLE = 1024


@torch.no_grad()
def step_along_axes(positions: Tensor, steps: Tensor, scales: Tensor, quats: Tensor) -> None:
    """Adds steps to positions, stretched along the axes of their Gaussians, in place.

    A step has the given length along an axis that is as long as the usual one: the median, over the
    Gaussians, of the middle one of their three axes.

    Args:
        positions: [N, 3].
        steps: [N, 3], as Adam would take them.
        scales: [N, 3] logarithms of the standard deviations along the axes.
        quats: [N, 4] rotations, wxyz of any length.

    Source: ours.
    """
    if not len(positions):
        return
    bound = log(LIMIT)
    factors = (scales - _usual(scales)).clamp_(-bound, bound).exp_()
    arrays = [positions, steps, factors, quats]
    if is_native(arrays) and all(each.is_contiguous() for each in arrays):
        from crossgrad_core.training.adam.numba_kernels.axes import move_rows

        move_rows(*(each.detach().numpy() for each in arrays))
        # NumPy wrote behind autograd's back: a graph that holds the old values must notice.
        torch.autograd.graph.increment_version(positions)
    else:
        positions.add_(stretched(steps, factors, quats))


def stretched(steps: Tensor, factors: Tensor, quats: Tensor) -> Tensor:
    """[N, 3] the steps times factors [N, 3] along the axes of rotations `quats` [N, 4]."""
    rotations = rotation_matrices(quats)
    along = torch.einsum("nji,nj->ni", rotations, steps)
    return torch.einsum("nij,nj->ni", rotations, factors * along)


def _usual(scales: Tensor) -> Tensor | float:
    """The median, of Gaussians evenly spread over memory, of the middle one of their axes.

    What is not finite is left out, so that it spoils no other Gaussian.
    """
    some = scales[:: -(-len(scales) // _SAMPLE)]
    if is_native([some]):  # NumPy begins sooner than torch.
        rows = some.numpy()
        # NaN comes last, as it does where torch sorts.
        a, b, c = np.where(np.isnan(rows), np.float32(inf), rows).T
        lengths = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
        lengths = lengths[np.isfinite(lengths)]
        place = (len(lengths) - 1) // 2
        return float(np.partition(lengths, place)[place]) if len(lengths) else nan
    middle = some.sort(dim=1).values[:, 1]
    return torch.where(middle.isfinite(), middle, torch.nan).nanmedian()
