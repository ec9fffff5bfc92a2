"""Grid cells: anchors by voxel rounding, automatic voxel size, and free cells."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: Smallest automatic voxel size, in local units, for a cloud of identical points.
SMALLEST_VOXEL = 1e-5
#: Automatic voxel size of a cloud without neighbours, in local units.
LONE_VOXEL = 0.01
#: Automatic voxel size, in units of the median distance between neighbours. With a value of 1,
#: nearly every point would get its own anchor. An anchor has ten Gaussians, but vanilla has one
#: Gaussian per point.
SPACING = 2.0
#: Cells that are farther from the origin than this are left out, because their integer coordinates
#: would not be exact.
FARTHEST = 2**40


def automatic_voxel_size(points: NDArray[np.float64]) -> float:
    """Return twice the median distance of the points to their nearest neighbour, local units.

    Scaffold-GS uses the median of the mean *squared* distance to three neighbours as a length. This
    value depends on the unit of the input, so it is not reproduced here.

    Args:
        points: [N, 3].
    """
    from scipy.spatial import cKDTree

    if points.shape[0] <= 1:
        return LONE_VOXEL
    distances, _ = cKDTree(points).query(points, k=2)
    return max(SPACING * float(np.median(distances[:, 1])), SMALLEST_VOXEL)


def voxel_centers(points: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Return the centres [P, 3] of the voxels that contain points, in lexicographic order.

    Source: Scaffold-GS, section 3.1: unique(round(p / v)) v.

    Args:
        points: [N, 3].
        size: Edge of a voxel, in the unit of the points.
    """
    cells = np.unique(np.round(points / size), axis=0)
    return np.asarray(cells * size)


def cells_of(positions: Tensor, size: float) -> Tensor:
    """Return the cell [N, 3] int64 of each position [N, 3]; halfway positions go to the even cell.

    Positions beyond `FARTHEST` cells and non-finite positions are moved to cell `FARTHEST`.
    """
    cells = (positions.double() / size).round()
    return cells.nan_to_num(FARTHEST, FARTHEST, -FARTHEST).clamp(-FARTHEST, FARTHEST).long()


def in_reach(cells: Tensor) -> Tensor:
    """Return a mask [N] of the cells that were not moved to `FARTHEST`."""
    return (cells.abs() < FARTHEST).all(1)


def numbered(cells: Tensor) -> Tensor:
    """Return numbers [N] int64 that are equal if and only if the cells [N, 3] are equal.

    Columns are numbered one by one so that no product overflows. This is much faster than `unique`
    of whole rows.
    """
    number = cells.new_zeros(cells.shape[0])
    for column in cells.unbind(1):
        values, value_index = torch.unique(column, return_inverse=True)
        number = torch.unique(number * len(values) + value_index, return_inverse=True)[1]
    return number


def free_cells(wanted: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct free cells among the wanted cells, and the index of each wanted cell.

    Args:
        wanted: [N, 3] int64.
        taken: [M, 3] int64.

    Returns:
        [C] int64 row in `wanted` of the first request for each free cell, in the order of
        `numbered`; [N] int64 index of each wanted cell in that list, -1 if the cell is taken.
    """
    number = numbered(torch.cat([wanted, taken]))
    count = int(number.max()) + 1 if len(number) else 0
    mine = number[: len(wanted)]
    first = torch.full((count,), len(wanted), device=wanted.device)
    rows = torch.arange(len(wanted), device=wanted.device)
    first.scatter_reduce_(0, mine, rows, "amin")
    free = first < len(wanted)
    free[number[len(wanted) :]] = False
    new_cell = torch.where(free, torch.cumsum(free, 0) - 1, -1)
    return first[free], new_cell[mine]
