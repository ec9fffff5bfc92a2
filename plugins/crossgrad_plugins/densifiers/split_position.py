"""Where along its longest axis a Gaussian is split: the least value of a fitted polynomial."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

#: The candidate planes as shares of the axis, which is six standard deviations long.
NODES = np.arange(1, 6) / 6.0
#: Where the polynomial is evaluated besides.
GRID = np.linspace(1.0 / 12.0, 11.0 / 12.0, 1000)


def split_positions(scores: Tensor) -> Tensor:
    """[S] share p of the axis that the left child gets, in [1/12, 11/12].

    The polynomial of degree 4 through the scores is searched on a grid and at its nodes. Of equal
    values the most central one counts, so that no preference means the middle.

    Args:
        scores: [S, 5] of the planes at p = 1/6 .. 5/6, finite.

    Source: DC4GS.
    """
    places, weights = _interpolation()
    lowest = scores.double() - scores.double().amin(dim=1, keepdim=True)
    values = lowest @ torch.from_numpy(weights).to(lowest)
    return torch.from_numpy(places).to(scores)[values.argmin(dim=1)]


def _interpolation() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places [Q], the central ones first, and Lagrange's weights [5, Q] of the scores there."""
    places = np.concatenate([NODES, GRID])
    places = places[np.argsort(np.abs(places - 0.5), kind="stable")]
    weights = np.ones((len(NODES), len(places)))
    for i, node in enumerate(NODES):
        for other in np.delete(NODES, i):
            weights[i] *= (places - other) / (node - other)
    return places, weights
