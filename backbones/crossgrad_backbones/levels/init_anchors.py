"""The anchors that a scene starts with: the points rounded to the lattice of every level."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_backbones.neighbours import nearest_neighbour_scales


@dataclass(frozen=True, eq=False)
class Planted:
    """Anchors of all levels, level by level.

    Attributes:
        positions: [A, 3] float64, local units.
        levels: [A] int64.
        spacings: [A] float64, initial scale of each anchor, local units.
    """

    positions: Tensor
    levels: Tensor
    spacings: Tensor

    def kept(self, mask: Tensor) -> "Planted":
        """Those of a mask [A]."""
        return Planted(self.positions[mask], self.levels[mask], self.spacings[mask])


def init_anchors(points: NDArray[np.float64], lattice: Lattice, *, everywhere: bool) -> Planted:
    """Anchors of every level: the points, rounded to the level's lattice, each site once.

    Initial scales come from the neighbouring sites of the same level, whether or not an anchor is
    planted there. The published code takes neighbours of any level, so that coarse anchors start as
    small as the fine ones around them; a camera that is far away sees coarse ones only, with gaps
    between them.

    Args:
        points: [P, 3] local units.
        lattice: The lattices.
        everywhere: Whether a site counts also where the points of the coarser site that it belongs
            to are all on it: its anchor repeats that of the coarser level.
    """
    origin = lattice.origin.numpy()
    levels = torch.arange(lattice.count)
    found, coarser = [], np.zeros(0, np.int64)
    for level, cell in enumerate(lattice.cells(levels).tolist()):
        sites, site = np.unique(np.round((points - origin) / cell), axis=0, return_inverse=True)
        site = site.reshape(-1)
        positions = sites * cell + origin
        spacings = nearest_neighbour_scales(positions)
        rows = np.arange(len(sites))
        if level > 0 and not everywhere:
            rows = np.unique(site[_parted(coarser, site)])
        numbers = np.full(len(rows), level)
        found.append(
            [torch.from_numpy(each) for each in (positions[rows], numbers, spacings[rows])]
        )
        coarser = site
    return Planted(*(torch.cat(each) for each in zip(*found, strict=True)))


def _parted(coarser: NDArray[np.int64], site: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[P] whether the points that share a point's coarser site are on several of the finer ones.

    Args:
        coarser: [P] number of each point's site on the level before.
        site: [P] number of its site.
    """
    pairs = np.unique(np.stack([coarser, site], axis=1), axis=0)
    return np.bincount(pairs[:, 0])[coarser] > 1


def visible_share(shares: Tensor, asked: float) -> float:
    """The share of the cameras that must see an anchor's level, and more, for it to stay.

    Args:
        shares: [A] share of the cameras that see the level of each anchor.
        asked: The option; a negative one asks for the mean share of all anchors.
    """
    return float(shares.mean()) if asked < 0.0 else asked
