"""Compute initial scales from the distances to nearest neighbours."""

import numpy as np
from numpy.typing import NDArray

#: Smallest mean squared distance to neighbours (3DGS), in squared local units.
SQUARED_DISTANCE_FLOOR = 1e-7


def nearest_neighbour_scales(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the initial scale of each point, equal for all axes (3DGS, section 5.1).

    Args:
        points: [P, 3] points in local units.

    Returns:
        [P] square root of the mean squared distance to the three nearest other points, or to fewer
        points if the cloud is smaller. A lower limit gives duplicate points a size, too.
    """
    from scipy.spatial import cKDTree

    count = points.shape[0]
    neighbours = min(3, count - 1)
    if neighbours < 1:
        return np.full(count, 0.01)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    squared = np.mean(distances[:, 1:] ** 2, axis=1)
    return np.asarray(np.sqrt(np.maximum(squared, SQUARED_DISTANCE_FLOOR)))
