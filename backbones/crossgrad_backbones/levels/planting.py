"""The anchors that a scene starts with: the points rounded to the lattice of every level."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.voxels import voxel_centers
from crossgrad_core.lattice import Lattice
from crossgrad_core.splats import nearest_neighbour_scales


def planted(points: NDArray[np.float64], lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Anchors of every level: the points, rounded to the level's lattice, each site once.

    Args:
        points: [P, 3] local units.
        lattice: The lattices.

    Returns:
        Positions [A, 3] float64 and levels [A] int64, level by level.
    """
    levels = torch.arange(lattice.count)
    origin = lattice.origin.numpy()
    each = [
        torch.from_numpy(voxel_centers(points, float(cell), origin))
        for cell in lattice.cells(levels)
    ]
    counts = torch.tensor([positions.shape[0] for positions in each])
    return torch.cat(each), levels.repeat_interleave(counts)


def spacings(
    positions: NDArray[np.float64], levels: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """[A] initial scale of each anchor, from its neighbours of the same level, local units.

    The published code takes neighbours of any level, so that coarse anchors start as small as the
    fine ones around them; a camera that is far away sees coarse ones only, with gaps between them.

    Args:
        positions: [A, 3] local units.
        levels: [A] their levels.
        count: Number of levels.
    """
    scales = np.empty(positions.shape[0])
    for level in range(count):
        rows = levels == level
        if rows.any():
            scales[rows] = nearest_neighbour_scales(positions[rows])
    return scales


def visible_share(shares: Tensor, asked: float) -> float:
    """The share of the cameras that must see an anchor's level, and more, for it to stay.

    Args:
        shares: [A] share of the cameras that see the level of each anchor.
        asked: The option; a negative one asks for the mean share of all anchors.
    """
    return float(shares.mean()) if asked < 0.0 else asked
