"""The gradient noise scale: how many views a step could use."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import Groups
from crossgrad_plugins.diagnostics.variance import variance_split


def noise_scale(gramian: NDArray[np.float64], groups: Groups) -> float:
    """tr(Sigma) / ||mean gradient||^2 of one block, both estimated without bias.

    Well below the noise scale, K views per step are worth about as much as K steps; well above it
    further views are wasted. The mean and the variance are those of the mixture of the groups with
    their shares. Infinite where the mean gradient cannot be told from zero; NaN without variance.

    Args:
        gramian: [V, V].
        groups: Which views are near, and the groups' shares.

    Source: McCandlish et al. 2018, the simple noise scale.
    """
    split = variance_split(gramian, groups)
    variance = split.within + split.between
    signal = _squared_mean(gramian, groups)
    if variance <= 0.0:
        return float("nan")
    return variance / signal if signal > 0.0 else float("inf")


def _squared_mean(gramian: NDArray[np.float64], groups: Groups) -> float:
    """Unbiased estimate of ||p near mean + q far mean||^2."""
    near, (n, m), (p, q) = groups.near, groups.sizes, groups.shares
    weights = np.where(near, p / n, q / m)
    plain = float(weights @ gramian @ weights)
    noise = 0.0
    for members, size, share, unseen in (
        (near, n, p, groups.unseen[0]),
        (~near, m, q, groups.unseen[1]),
    ):
        own = gramian[np.ix_(members, members)]
        spread = (float(np.trace(own)) - float(own.sum()) / size) / (size - 1)
        noise += share**2 * unseen * spread / size
    return plain - noise
