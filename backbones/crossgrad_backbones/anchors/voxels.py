"""Anchors by voxel rounding, and the voxel size that a point cloud asks for."""

import numpy as np
from numpy.typing import NDArray

#: Smallest automatic voxel size, local units: that of a cloud of identical points.
SMALLEST_VOXEL = 1e-5
#: The automatic voxel size of a cloud without neighbours, local units.
LONE_VOXEL = 0.01
#: The automatic voxel size, in median distances between neighbours. With 1, nearly every point gets
#: an anchor of its own, hence ten Gaussians where vanilla has one.
SPACING = 2.0


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
