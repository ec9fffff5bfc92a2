"""The nested lattices of an octree: number of levels, and the viewing distance of each level."""

from dataclasses import dataclass, replace
from math import floor, log, log2

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.voxels import automatic_voxel_size

#: Maximum number of levels, more than any usual scene needs.
MOST_LEVELS = 16
#: Smallest edge of a cell, relative to the largest coordinate. Float32 rounds positions to 2^-24 of
#: their magnitude.
RESOLUTION = 2.0**-20
#: The smallest and largest coordinate of the initial points are multiplied by this factor
#: (Octree-GS).
BOX_FACTOR = 1.1


def root_cell(edge: float, base_layer: int, wanted: float) -> float:
    """Return the edge of a cell at level 0: the edge of the cube / 2^base_layer (Octree-GS).

    Args:
        edge: Edge of the cube in local units.
        base_layer: Number of times the cube is halved. With -1, the cube is halved until cells have
            about the edge `wanted`.
        wanted: Wanted edge in local units. If the cube has no size, `wanted` is the result.
    """
    if edge <= 0.0:
        return wanted
    if base_layer < 0:
        base_layer = round(log2(edge / wanted))
    return edge * 2.0**-base_layer


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cubic lattices, one for each level.

    The cells of a level are `fork` times smaller than on the previous level (Octree-GS).

    All fields are float64 tensors, so that a training step need not wait for a transfer from the
    GPU.

    Attributes:
        origin: [3] corner of all lattices in local units.
        root_cell: [] edge of a cell at level 0 in local units.
        fork: [] number of cells of the next level along the edge of a cell.
        levels: [] number of levels.
        distance: [] standard distance D in local units. At the distance D, L* = log_fork(D /
            distance) is 0.
        lead: [] number of levels above L* that a camera uses. `lead` is 0 if L* is rounded down,
            1/2 if L* is rounded to the nearest level, and 1 if L* is rounded up.
        visible_share: [] an anchor is pruned if at most this share of the cameras uses its level.
    """

    origin: Tensor
    root_cell: Tensor
    fork: Tensor
    levels: Tensor
    distance: Tensor
    lead: Tensor
    visible_share: Tensor

    @classmethod
    def of(cls, packed: Tensor) -> "Lattice":
        """Create the lattices from a tensor [9] that `packed` returned."""
        return cls(packed[:3], *packed[3:].unbind())

    def packed(self) -> Tensor:
        """Return all fields in one tensor [9] float64, which a backbone stores as a parameter."""
        scalars = (self.root_cell, self.fork, self.levels, self.distance, self.lead)
        return torch.cat([self.origin, torch.stack([*scalars, self.visible_share])]).double()

    def with_prune_threshold(self, visible_share: float) -> "Lattice":
        """Return the lattices with another pruning threshold."""
        return replace(self, visible_share=torch.full_like(self.visible_share, visible_share))

    @property
    def count(self) -> int:
        """Number of levels, as a Python integer."""
        return int(self.levels)

    def cells(self, levels: Tensor) -> Tensor:
        """Return the edges [A] float64 of the cells of levels [A], in local units."""
        return self.root_cell * self.fork ** (-levels.double())

    def coordinates(self, points: Tensor, levels: Tensor) -> Tensor:
        """Return the lattice coordinates [A, 3] float64 of points [A, 3].

        The unit is a cell of the point's level, and the coordinates start at the origin.

        Rounding the coordinates gives the lattice site that is nearest to each point.
        """
        return (points.double() - self.origin) / self.cells(levels)[:, None]

    def positions(self, sites: Tensor, levels: Tensor) -> Tensor:
        """Return the positions [A, 3] float64 of the sites [A, 3] of levels [A], in local units."""
        return sites.double() * self.cells(levels)[:, None] + self.origin

    def distances(self, anchors: Tensor, levels: Tensor, camera: Tensor) -> Tensor:
        """Return the distances [A] from a camera centre [3] to anchors [A, 3].

        As in Octree-GS, the anchors are moved by half a cell.

        Source: Octree-GS (Ren et al. 2024).
        """
        halves = 0.5 * self.root_cell * self._forks(-levels.to(anchors))
        squares = torch.zeros_like(halves)
        at = camera.to(anchors, non_blocking=True)
        for along, center in zip(anchors.unbind(1), at.unbind(), strict=True):
            squares += (along + halves - center).square()
        return squares.sqrt()

    def detail(self, distances: Tensor, extra: Tensor) -> Tensor:
        """Return the level L* = log_fork(D / distance) + extra level of each anchor [A].

        L* is infinite for a distance of 0.
        """
        octaves = torch.log2(self.distance.to(distances) / distances)
        return octaves / torch.log2(self.fork) + extra

    def seen(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """Return a mask [A] of the anchors that a camera uses.

        The anchors have levels [A] and distances [A].

        An anchor is used if its level is at most L* + lead. Level 0 is always used. At a distance
        exactly between two levels, the finer level is used.
        """
        farthest = self.distance * self._forks(self.lead + extra - levels.to(extra))
        return (levels == 0) | (distances <= farthest)

    def _forks(self, exponents: Tensor) -> Tensor:
        """Return fork^exponents in the floating-point type of `exponents`."""
        # Do not use exp2, because its rounding depends on the number of threads.
        return torch.exp(torch.log(self.fork) * exponents)

    def faded(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """Return opacity factors [A] in [0, 1] that fade in the finest used level (Octree-GS).

        The factor of the finest used level is the fractional part of L* + 1. No anchor appears or
        disappears abruptly when the camera moves, because this factor is continuous. Coarser levels
        and level 0 have a factor of 1.
        """
        factor = (self.detail(distances, extra) + 1.0 - levels.to(distances)).clamp(0.0, 1.0)
        return torch.where(levels == 0, torch.ones_like(factor), factor)

    def shares(self, anchors: Tensor, levels: Tensor, cameras: Tensor) -> Tensor:
        """Return the share of cameras [A] float64 that use the level of each anchor [A, 3].

        Only the distances from the camera centres [C, 3] matter, not the view directions.
        """
        extra = torch.zeros_like(anchors[:, 0])
        seen = torch.zeros(anchors.shape[0], dtype=torch.float64, device=anchors.device)
        for camera in cameras:
            seen += self.seen(self.distances(anchors, levels, camera), levels, extra)
        return seen / max(1, cameras.shape[0])

    def keep_levels(self, shares: Tensor) -> Tensor:
        """Return a mask [A] of the anchors that are not pruned.

        `shares` contains the share of cameras that use each anchor's level.

        An anchor whose level all cameras use is never pruned. Without this rule, a threshold equal
        to the mean share would remove all anchors if all cameras have equal distances.
        """
        return (shares > self.visible_share) | (shares >= 1.0)


def distance_range(
    points: NDArray[np.float64], centers: NDArray[np.float64], ratio: float
) -> tuple[float, float]:
    """Return a robust largest and smallest distance between cameras and points (Octree-GS).

    For each camera, the quantiles 1 - `ratio` and `ratio` of its distances to all points are
    computed. The results are the quantiles 1 - `ratio` and `ratio` of all these values.

    Args:
        points: [P, 3] points, P >= 1.
        centers: [C, 3] camera centres, C >= 1.
        ratio: Quantile for the largest distance, for instance 0.999.

    Returns:
        The standard distance D and the smallest distance d. Both distances are positive.
    """
    quantiles = (1.0 - ratio, ratio)
    pooled = [np.quantile(np.linalg.norm(points - c, axis=1), quantiles) for c in centers]
    smallest, largest = (float(value) for value in np.quantile(pooled, quantiles))
    # If all points and cameras are at the same position, any distance is valid.
    largest = largest if largest > 0.0 else 1.0
    return largest, max(smallest, largest * 2.0**-MOST_LEVELS)


def number_of_levels(largest: float, smallest: float, fork: int) -> int:
    """Return round(log_fork(D / d)) + 1 (Octree-GS), but at most `MOST_LEVELS`.

    D is the largest and d the smallest distance.
    """
    return min(round(log(largest / smallest) / log(fork)) + 1, MOST_LEVELS)


def bounding_range(points: NDArray[np.float64]) -> tuple[float, float]:
    """Return the lowest corner and the edge of a cube around all points (Octree-GS).

    The three coordinates of the corner are equal, so that only one number is returned.

    The limits are 1.1 times the smallest and 1.1 times the largest coordinate of all points. If all
    coordinates are equal, the edge is 0.
    """
    low, high = BOX_FACTOR * float(points.min()), BOX_FACTOR * float(points.max())
    return low, max(high - low, 0.0)


def automatic_root_cell(points: NDArray[np.float64]) -> float:
    """Return four times the median distance between neighbouring points, in local units.

    The result is twice the automatic voxel size of `scaffold`. For any number of finer levels, the
    most distant cameras use anchors that are about as dense as the points.

    Args:
        points: [P, 3] points in local units.
    """
    return 2.0 * automatic_voxel_size(points)


def root_above(middle_cell: float, levels: int, fork: int) -> float:
    """Return the edge of a cell at level 0 (Octree-GS).

    With this edge, cells at level `levels // 2 - 1` have the edge `middle_cell`.
    """
    return middle_cell * float(fork) ** (levels // 2 - 1)


def resolvable_levels(levels: int, fork: int, cell: float, reach: float) -> int:
    """Return how many levels float32 positions can represent; at least 1.

    Args:
        levels: Wanted number of levels.
        fork: Number of cells of the next level along the edge of a cell.
        cell: Edge of a cell at level 0 in local units.
        reach: Largest coordinate of all points in local units.
    """
    if reach <= 0.0:
        return levels
    finer = floor(log(cell / (RESOLUTION * reach)) / log(fork))
    return max(1, min(levels, 1 + finer))
