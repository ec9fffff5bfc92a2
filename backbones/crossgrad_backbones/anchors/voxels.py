"""Cells of a grid: anchors by voxel rounding, the size of a voxel, and free cells."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: Smallest automatic voxel size, local units: that of a cloud of identical points.
SMALLEST_VOXEL = 1e-5
#: The automatic voxel size of a cloud without neighbours, local units.
LONE_VOXEL = 0.01
#: The automatic voxel size, in median distances between neighbours. With 1, nearly every point gets
#: an anchor of its own, hence ten Gaussians where vanilla has one.
SPACING = 2.0
#: Cells farther from the origin than this are left out: their numbers would not be exact.
FARTHEST = 2**40


def automatic_voxel_size(points: NDArray[np.float64]) -> float:
    """Twice the median over the points of the distance to the nearest other one, local units.

    Scaffold-GS takes the median of the mean *squared* distance to three neighbours for a length;
    that depends on the unit of the input, so it is not reproduced here.

    Args:
        points: [N, 3].
    """
    from scipy.spatial import cKDTree

    if points.shape[0] <= 1:
        return LONE_VOXEL
    distances, _ = cKDTree(points).query(points, k=2)
    return max(SPACING * float(np.median(distances[:, 1])), SMALLEST_VOXEL)


def voxel_centers(points: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """[P, 3] centres of the voxels that hold a point, each once, in lexicographic order.

    Source: Scaffold-GS, section 3.1: unique(round(p / v)) v.

    Args:
        points: [N, 3].
        size: Edge of a voxel, in the unit of the points.
    """
    cells = np.unique(np.round(points / size), axis=0)
    return np.asarray(cells * size)


def cells_of(positions: Tensor, size: float) -> Tensor:
    """[N, 3] int64 cell of each position [N, 3]; half-way positions go to the even cell.

    Positions beyond `FARTHEST` cells, and those that are not finite, are moved to it.
    """
    cells = (positions.double() / size).round()
    return cells.nan_to_num(FARTHEST, FARTHEST, -FARTHEST).clamp(-FARTHEST, FARTHEST).long()


def in_reach(cells: Tensor) -> Tensor:
    """[N] bool, cells that were not moved."""
    return (cells.abs() < FARTHEST).all(1)


def numbered(cells: Tensor) -> Tensor:
    """[N] int64, the same number for equal cells [N, 3] and for no others.

    Column by column, so that no product overflows: much faster than `unique` of whole rows.
    """
    number = cells.new_zeros(cells.shape[0])
    for column in cells.unbind(1):
        values, place = torch.unique(column, return_inverse=True)
        number = torch.unique(number * len(values) + place, return_inverse=True)[1]
    return number


def free_cells(wanted: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
    """The wanted cells that nothing occupies, each once, and who wants which.

    Args:
        wanted: [N, 3] int64.
        taken: [M, 3] int64.

    Returns:
        [C] int64 row in `wanted` of the first that wants each free cell, in the order of
        `numbered`; [N] int64 position of each wanted cell in that list, -1 where it is taken.
    """
    number = numbered(torch.cat([wanted, taken]))
    count = int(number.max()) + 1 if len(number) else 0
    mine = number[: len(wanted)]
    first = torch.full((count,), len(wanted), device=wanted.device)
    rows = torch.arange(len(wanted), device=wanted.device)
    first.scatter_reduce_(0, mine, rows, "amin")
    free = first < len(wanted)
    free[number[len(wanted) :]] = False
    place = torch.where(free, torch.cumsum(free, 0) - 1, -1)
    return first[free], place[mine]
