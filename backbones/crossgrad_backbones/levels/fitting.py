"""How many levels of detail a scene needs, and how coarse the coarsest is."""

from math import floor, log, log2

import numpy as np
from numpy.typing import NDArray

from crossgrad_backbones.anchors.voxels import automatic_voxel_size

#: More levels than any scene needs.
MOST_LEVELS = 16
#: The least edge of a cell, largest coordinates: float32 positions round to half of 2^-23 of them.
RESOLUTION = 2.0**-20
#: Limits of the initial points are moved away from 0 by this factor (Octree-GS).
BOX_FACTOR = 1.1


def distance_range(
    points: NDArray[np.float64], centers: NDArray[np.float64], ratio: float
) -> tuple[float, float]:
    """The largest and the smallest usual distance between cameras and points (Octree-GS).

    Of each camera the quantiles 1 - ratio and ratio of its distances to all points are taken; the
    result are the same quantiles of these.

    Args:
        points: [P, 3], P >= 1.
        centers: [C, 3] camera centres, C >= 1.
        ratio: For instance 0.999.

    Returns:
        The standard distance D and the smallest distance d, both positive.
    """
    quantiles = (1.0 - ratio, ratio)
    pooled = [np.quantile(np.linalg.norm(points - c, axis=1), quantiles) for c in centers]
    smallest, largest = (float(value) for value in np.quantile(pooled, quantiles))
    # All points in one place, and all cameras there too: any distance will do.
    largest = largest if largest > 0.0 else 1.0
    return largest, max(smallest, largest * 2.0**-MOST_LEVELS)


def number_of_levels(largest: float, smallest: float, fork: int) -> int:
    """round(log_fork(D / d)) + 1 (Octree-GS), at most `MOST_LEVELS`."""
    return min(round(log(largest / smallest) / log(fork)) + 1, MOST_LEVELS)


def bounding_range(points: NDArray[np.float64]) -> tuple[float, float]:
    """The corner's coordinate, the same for all axes, and the edge of the cube (Octree-GS).

    1.1 times the smallest and the largest coordinate of all points and axes; where all coordinates
    are equal the edge is 0.
    """
    low, high = BOX_FACTOR * float(points.min()), BOX_FACTOR * float(points.max())
    return low, max(high - low, 0.0)


def automatic_root_cell(points: NDArray[np.float64]) -> float:
    """Four median distances between neighbours, local units.

    Twice the automatic voxel of Scaffold-GS: what the farthest cameras see is about as fine as the
    points are dense, however many finer levels there are for near ones.

    Args:
        points: [P, 3] local units.
    """
    return 2.0 * automatic_voxel_size(points)


def root_above(middle_cell: float, levels: int, fork: int) -> float:
    """Edge of level 0's cells where those below the middle level are `middle_cell` (Octree-GS)."""
    return middle_cell * float(fork) ** (levels // 2 - 1)


def root_cell(edge: float, base_layer: int, wanted: float) -> float:
    """Edge of a cell of level 0: the cube's edge / 2^base_layer (Octree-GS).

    Args:
        edge: The cube's edge, local units.
        base_layer: How often the cube is halved; -1: until its cells are about `wanted` large.
        wanted: Local units; the answer where the cube has no size.
    """
    if edge <= 0.0:
        return wanted
    if base_layer < 0:
        base_layer = round(log2(edge / wanted))
    return edge * 2.0**-base_layer


def resolvable_levels(levels: int, fork: int, cell: float, reach: float) -> int:
    """How many of the levels have cells that float32 positions can tell apart, at least 1.

    Args:
        levels: Wanted.
        fork: Cells of the next level along an edge.
        cell: Edge of a cell of level 0, local units.
        reach: Largest coordinate of a point, local units.
    """
    if reach <= 0.0:
        return levels
    finer = floor(log(cell / (RESOLUTION * reach)) / log(fork))
    return max(1, min(levels, 1 + finer))
