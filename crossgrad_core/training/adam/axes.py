"""Position steps in units of the Gaussians: along each axis, by a share of its length.

Adam gives every position steps of the same length. With such steps, a small Gaussian on a near wall
jumps over its neighbours, while a large Gaussian on the ground below a drone hardly moves. Scenes
with very different camera distances contain both kinds (docs/schedules.md).
"""

from math import inf, log, nan
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.columns import is_native
from crossgrad_core.numerics.rotations import rotation_matrices

#: Maximum ratio of an axis length to the typical axis length. The inverse ratio has the same limit.
LIMIT: Final = 5.0
#: Largest number of Gaussians that are sampled for the typical length.
_SAMPLE = 1024


@torch.no_grad()
def step_along_axes(positions: Tensor, steps: Tensor, scales: Tensor, quats: Tensor) -> None:
    """Add steps to positions in place, stretched along the axes of their Gaussians.

    A step keeps its length along an axis of typical length. Each Gaussian has three axis lengths.
    The typical length is the median of the middle lengths over all Gaussians.

    Args:
        positions: [N, 3].
        steps: [N, 3], as Adam would take them.
        scales: [N, 3] logarithms of the standard deviations along the axes.
        quats: [N, 4] rotations, wxyz of any length.

    Source: developed for crossgrad.
    """
    if not len(positions):
        return
    bound = log(LIMIT)
    factors = (scales - _usual(scales)).clamp_(-bound, bound).exp_()
    arrays = [positions, steps, factors, quats]
    if is_native(arrays) and all(array.is_contiguous() for array in arrays):
        from crossgrad_core.training.adam.numba_kernels.axes import move_rows

        move_rows(*(array.detach().numpy() for array in arrays))
        # NumPy wrote without autograd, so invalidate graphs that use the old values.
        torch.autograd.graph.increment_version(positions)
    else:
        positions.add_(stretched(steps, factors, quats))


def stretched(steps: Tensor, factors: Tensor, quats: Tensor) -> Tensor:
    """Return the steps [N, 3] times factors [N, 3] along the axes of rotations `quats` [N, 4]."""
    rotations = rotation_matrices(quats)
    along = torch.einsum("nji,nj->ni", rotations, steps)
    return torch.einsum("nij,nj->ni", rotations, factors * along)


def _usual(scales: Tensor) -> Tensor | float:
    """Return the median middle log scale of Gaussians that are evenly spread over memory.

    Non-finite values are left out, so that they do not affect other Gaussians.
    """
    sample = scales[:: -(-len(scales) // _SAMPLE)]
    if is_native([sample]):  # Use NumPy, because it has less overhead than torch.
        rows = sample.numpy()
        # Sort NaN to the end, as torch does.
        a, b, c = np.where(np.isnan(rows), np.float32(inf), rows).T
        lengths = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
        lengths = lengths[np.isfinite(lengths)]
        middle_row = (len(lengths) - 1) // 2
        return float(np.partition(lengths, middle_row)[middle_row]) if len(lengths) else nan
    middle = sample.sort(dim=1).values[:, 1]
    return torch.where(middle.isfinite(), middle, torch.nan).nanmedian()
