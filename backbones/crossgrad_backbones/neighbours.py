"""Initial scales from distances to nearest neighbours."""

import numpy as np
from numpy.typing import NDArray

#: Floor of the mean squared neighbour distance (3DGS), in squared local units.
SQUARED_DISTANCE_FLOOR = 1e-7


def nearest_neighbour_scales(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the isotropic initial scale of each point (3DGS, section 5.1).

    Args:
        points: [P, 3].

    Returns:
        [P] square root of the mean squared distance to the 3 nearest other points (all other points
        if there are fewer), with a floor so that duplicates get a size too.
    """
    from scipy.spatial import cKDTree

    count = points.shape[0]
    neighbours = min(3, count - 1)
    if neighbours < 1:
        return np.full(count, 0.01)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    squared = np.mean(distances[:, 1:] ** 2, axis=1)
    return np.asarray(np.sqrt(np.maximum(squared, SQUARED_DISTANCE_FLOOR)))
