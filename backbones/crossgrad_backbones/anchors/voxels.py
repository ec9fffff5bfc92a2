"""Cells of a grid: anchors at rounded positions, automatic voxel size, and empty cells."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: Smallest automatic voxel size, in local units; used if all points are equal.
SMALLEST_VOXEL = 1e-5
#: Automatic voxel size of a cloud with a single point, in local units.
LONE_VOXEL = 0.01
#: Automatic voxel size, relative to the median distance between neighbouring points. With a factor
#: of 1, nearly every point would become an anchor. Nearly every point as an anchor would give too
#: many Gaussians: an anchor has ten Gaussians, but `vanilla` has one Gaussian per point.
SPACING = 2.0
#: Cells at least this number of cells from the origin are left out, because their integer
#: coordinates would not be exact.
FARTHEST = 2**40


def automatic_voxel_size(points: NDArray[np.float64]) -> float:
    """Return twice the median distance from a point to its nearest neighbour, in local units.

    Scaffold-GS instead takes the median of the mean *squared* distance to three neighbours as a
    length. The median of squared distances depends on the unit of the input, so this length is not
    used here.

    Args:
        points: [N, 3] points in local units.
    """
    from scipy.spatial import cKDTree

    if points.shape[0] <= 1:
        return LONE_VOXEL
    distances, _ = cKDTree(points).query(points, k=2)
    return max(SPACING * float(np.median(distances[:, 1])), SMALLEST_VOXEL)


def voxel_centers(points: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Return the centres [P, 3] of all voxels that contain points, sorted by coordinates.

    Source: Scaffold-GS, section 3.1: unique(round(p / v)) v, for points p and voxel size v.

    Args:
        points: [N, 3] points.
        size: Edge of a voxel, in the unit of the points.
    """
    cells = np.unique(np.round(points / size), axis=0)
    return np.asarray(cells * size)


def cells_of(positions: Tensor, size: float) -> Tensor:
    """Return the cell [N, 3] int64 of each position [N, 3].

    Positions halfway between two cells get the even cell.

    Positions beyond `FARTHEST` cells, and positions that are not finite, are moved to cell
    `FARTHEST`.
    """
    cells = (positions.double() / size).round()
    return cells.nan_to_num(FARTHEST, FARTHEST, -FARTHEST).clamp(-FARTHEST, FARTHEST).long()


def in_reach(cells: Tensor) -> Tensor:
    """Return a mask [N] of the cells that were not moved to `FARTHEST`."""
    return (cells.abs() < FARTHEST).all(1)


def numbered(cells: Tensor) -> Tensor:
    """Return numbers [N] int64 that are equal exactly if the cells [N, 3] are equal.

    The columns are processed one after another, so that no product overflows. Numbering the columns
    is much faster than `unique` for complete rows.
    """
    number = cells.new_zeros(cells.shape[0])
    for column in cells.unbind(1):
        values, value_index = torch.unique(column, return_inverse=True)
        number = torch.unique(number * len(values) + value_index, return_inverse=True)[1]
    return number


def free_cells(wanted: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct empty cells among the wanted cells.

    Also return, for each wanted cell, its position in the list of empty cells.

    Args:
        wanted: [N, 3] int64 wanted cells.
        taken: [M, 3] int64 cells that are not empty.

    Returns:
        [C] int64: for each distinct empty cell, the first row in `wanted`, sorted by the numbers
        from `numbered`. [N] int64: for each wanted cell, its position in the list of empty cells;
        -1 if the cell is taken.
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
