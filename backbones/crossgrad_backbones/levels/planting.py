"""The anchors that a scene starts with: the points rounded to the lattice of every level."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.lattice import Lattice
from crossgrad_core.splats import nearest_neighbour_scales


def planted(
    points: NDArray[np.float64], lattice: Lattice, *, everywhere: bool
) -> tuple[Tensor, Tensor]:
    """Anchors of every level: the points, rounded to the level's lattice, each site once.

    Args:
        points: [P, 3] local units.
        lattice: The lattices.
        everywhere: Whether a site counts also where the points of the coarser site that it belongs
            to are all on it: its anchor repeats that of the coarser level.

    Returns:
        Positions [A, 3] float64 and levels [A] int64, level by level.
    """
    origin = lattice.origin.numpy()
    levels = torch.arange(lattice.count)
    positions, coarser = [], np.zeros(0, np.int64)
    for level, cell in enumerate(lattice.cells(levels).tolist()):
        sites, site = np.unique(np.round((points - origin) / cell), axis=0, return_inverse=True)
        site = site.reshape(-1)
        if level > 0 and not everywhere:
            sites = sites[np.unique(site[_parted(coarser, site)])]
        positions.append(torch.from_numpy(sites * cell + origin))
        coarser = site
    counts = torch.tensor([each.shape[0] for each in positions])
    return torch.cat(positions), levels.repeat_interleave(counts)


def _parted(coarser: NDArray[np.int64], site: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[P] whether the points that share a point's coarser site are on several of the finer ones.

    Args:
        coarser: [P] number of each point's site on the level before.
        site: [P] number of its site.
    """
    pairs = np.unique(np.stack([coarser, site], axis=1), axis=0)
    return np.bincount(pairs[:, 0])[coarser] > 1


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
