"""Position steps in proportion to the size of each Gaussian, separately along each of its axes.

Adam gives all positions steps of about equal length. With equal steps, a small Gaussian on a near
wall jumps over its neighbours, while a large Gaussian on the ground below a drone hardly moves. A
scene with very different camera distances contains small and large Gaussians (docs/schedules.md).
"""

from math import inf, log, nan
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.columns import is_native
from crossgrad_core.numerics.rotations import rotation_matrices

#: Maximum ratio of an axis length to the typical axis length. The minimum ratio is the inverse of
#: this number.
LIMIT: Final = 5.0
#: Largest number of Gaussians in the sample for the typical axis length.
_SAMPLE = 1024


@torch.no_grad()
def step_along_axes(positions: Tensor, steps: Tensor, scales: Tensor, quats: Tensor) -> None:
    """Add steps to positions in place, after stretching each step along the axes of its Gaussian.

    The length of a step does not change along an axis of typical length. Each Gaussian has three
    axis lengths. The typical length is a median over all Gaussians. The median is computed over the
    middle of the three axis lengths of each Gaussian.

    Args:
        positions: [N, 3].
        steps: [N, 3] steps that Adam would take.
        scales: [N, 3] logarithms of the standard deviations along the three axes.
        quats: [N, 4] rotations as quaternions (w, x, y, z) of any length.

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
    """Return steps [N, 3], scaled by `factors` [N, 3] along the axes of rotations `quats`."""
    rotations = rotation_matrices(quats)
    along = torch.einsum("nji,nj->ni", rotations, steps)
    return torch.einsum("nij,nj->ni", rotations, factors * along)


def _usual(scales: Tensor) -> Tensor | float:
    """Return the median of the Gaussians' middle log scales, computed over a sample.

    The sample is evenly spread over the rows. Non-finite values are left out, because a NaN median
    would affect all Gaussians.
    """
    sample = scales[:: -(-len(scales) // _SAMPLE)]
    if is_native([sample]):  # For this small sample, NumPy has less overhead than torch.
        rows = sample.numpy()
        # Replace NaN by infinity, so that NaN is sorted to the end, as in torch.
        a, b, c = np.where(np.isnan(rows), np.float32(inf), rows).T
        lengths = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
        lengths = lengths[np.isfinite(lengths)]
        middle_row = (len(lengths) - 1) // 2
        return float(np.partition(lengths, middle_row)[middle_row]) if len(lengths) else nan
    middle = sample.sort(dim=1).values[:, 1]
    return torch.where(middle.isfinite(), middle, torch.nan).nanmedian()
