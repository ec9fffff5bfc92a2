"""What operators share that give each gradient one weight."""

import numpy as np
from numpy.typing import NDArray


def weighting(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """[B, K, K] matrices that multiply each of K gradients by its weight; `weights` is [B, K]."""
    blocks, views = weights.shape
    matrices = np.zeros((blocks, views, views))
    matrices.reshape(blocks, -1)[:, :: views + 1] = weights
    return matrices
