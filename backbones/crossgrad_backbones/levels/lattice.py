"""Nested lattices of an octree: their number, and from how far each level is seen."""

from dataclasses import dataclass, replace
from math import floor, log, log2

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.voxels import automatic_voxel_size

#: More levels than any scene needs.
MOST_LEVELS = 16
#: The least edge of a cell, largest coordinates: float32 positions round to half of 2^-23 of them.
RESOLUTION = 2.0**-20
#: Limits of the initial points are moved away from 0 by this factor (Octree-GS).
BOX_FACTOR = 1.1


def root_cell(edge: float, base_layer: int, wanted: float) -> float:
    """Edge of a cell of level 0: the cube's edge / 2^base_layer (Octree-GS).

    Args:
        edge: The cube's edge, local units.
        base_layer: How often the cube is halved; -1: until its cells are about `wanted` large.
        wanted: Local units; the answer where the cube has no size.
    """
    if edge <= 0.0:
        return wanted
    if base_layer < 0:
        base_layer = round(log2(edge / wanted))
    return edge * 2.0**-base_layer


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cubic lattices, one per level, each `fork` times finer than the one before (Octree-GS).

    All fields are float64 tensors, so that a step need not wait for a device to read them.

    Attributes:
        origin: [3] corner of the lattices, local units.
        root_cell: [] edge of a cell of level 0, local units.
        fork: [] cells of the next level along an edge.
        levels: [] how many levels there are.
        distance: [] standard distance D, local units: L* = log_fork(D / distance) is 0 there.
        lead: [] how many levels beyond L* a camera sees: 0 where L* is rounded down, 1/2 where it
            is rounded to the nearest level, 1 where it is rounded up.
        visible_share: [] anchors that at most this share of the cameras sees are weeded out.
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
        """The lattices in a tensor [9] that `packed` made, or in a copy of it."""
        return cls(packed[:3], *packed[3:].unbind())

    def packed(self) -> Tensor:
        """[9] float64, everything in one tensor: a backbone keeps it among its parameters."""
        scalars = (self.root_cell, self.fork, self.levels, self.distance, self.lead)
        return torch.cat([self.origin, torch.stack([*scalars, self.visible_share])]).double()

    def with_prune_threshold(self, visible_share: float) -> "Lattice":
        """The same lattices with another threshold of weeding."""
        return replace(self, visible_share=torch.full_like(self.visible_share, visible_share))

    @property
    def count(self) -> int:
        """Number of levels, on the host."""
        return int(self.levels)

    def cells(self, levels: Tensor) -> Tensor:
        """[A] float64, edge of a cell of each level [A], local units."""
        return self.root_cell * self.fork ** (-levels.double())

    def coordinates(self, points: Tensor, levels: Tensor) -> Tensor:
        """[A, 3] float64, points [A, 3] in units of the cells of their levels [A], from the origin.

        Rounded to whole numbers they are the site of the lattice next to each point.
        """
        return (points.double() - self.origin) / self.cells(levels)[:, None]

    def positions(self, sites: Tensor, levels: Tensor) -> Tensor:
        """[A, 3] float64, where sites [A, 3] of levels [A] are, local units."""
        return sites.double() * self.cells(levels)[:, None] + self.origin

    def distances(self, anchors: Tensor, levels: Tensor, camera: Tensor) -> Tensor:
        """[A] distance of a camera centre [3] from anchors [A, 3] moved by half a cell.

        Source: Octree-GS, methods of section 6.
        """
        halves = 0.5 * self.root_cell * self._forks(-levels.to(anchors))
        squares = torch.zeros_like(halves)
        at = camera.to(anchors, non_blocking=True)
        for along, center in zip(anchors.unbind(1), at.unbind(), strict=True):
            squares += (along + halves - center).square()
        return squares.sqrt()

    def detail(self, distances: Tensor, extra: Tensor) -> Tensor:
        """[A] L* = log_fork(D / distance) + extra level; infinite at distance 0."""
        octaves = torch.log2(self.distance.to(distances) / distances)
        return octaves / torch.log2(self.fork) + extra

    def seen(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """[A] bool, whether anchors of levels [A] are drawn at distances [A] from a camera.

        An anchor is drawn where its level is at most L* + lead; level 0 always is. A distance that
        is exactly between two levels belongs to the finer one.
        """
        farthest = self.distance * self._forks(self.lead + extra - levels.to(extra))
        return (levels == 0) | (distances <= farthest)

    def _forks(self, exponents: Tensor) -> Tensor:
        """fork^exponents, in the type of the exponents: a step computes it for every anchor."""
        # Not exp2: its rounding depends on the number of threads.
        return torch.exp(torch.log(self.fork) * exponents)

    def faded(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """[A] in [0, 1], opacity factor of anchors where the boundary level fades in (Octree-GS).

        The finest level that is seen has the fraction of L* + 1, so that nothing appears or
        vanishes at once where the camera moves; coarser levels have 1, and level 0 always has.
        """
        factor = (self.detail(distances, extra) + 1.0 - levels.to(distances)).clamp(0.0, 1.0)
        return torch.where(levels == 0, torch.ones_like(factor), factor)

    def shares(self, anchors: Tensor, levels: Tensor, cameras: Tensor) -> Tensor:
        """[A] float64, share of the cameras (centres [C, 3]) that see each anchor [A, 3]'s level.

        Only the distance counts, not the direction in which a camera looks.
        """
        extra = torch.zeros_like(anchors[:, 0])
        seen = torch.zeros(anchors.shape[0], dtype=torch.float64, device=anchors.device)
        for camera in cameras:
            seen += self.seen(self.distances(anchors, levels, camera), levels, extra)
        return seen / max(1, cameras.shape[0])

    def keep_levels(self, shares: Tensor) -> Tensor:
        """[A] bool, anchors that are not weeded out, by the share of cameras that see them.

        What every camera sees always stays: with an automatic threshold (the mean share) and all
        cameras equally far away, nothing would be left otherwise.
        """
        return (shares > self.visible_share) | (shares >= 1.0)


def distance_range(
    points: NDArray[np.float64], centers: NDArray[np.float64], ratio: float
) -> tuple[float, float]:
    """The largest and the smallest usual distance between cameras and points (Octree-GS).

    Of each camera the quantiles 1 - ratio and ratio of its distances to all points are taken; the
    result are the same quantiles of these.

    Args:
        points: [P, 3], P >= 1.
        centers: [C, 3] camera centres, C >= 1.
        ratio: For instance 0.999.

    Returns:
        The standard distance D and the smallest distance d, both positive.
    """
    quantiles = (1.0 - ratio, ratio)
    pooled = [np.quantile(np.linalg.norm(points - c, axis=1), quantiles) for c in centers]
    smallest, largest = (float(value) for value in np.quantile(pooled, quantiles))
    # All points in one place, and all cameras there too: any distance will do.
    largest = largest if largest > 0.0 else 1.0
    return largest, max(smallest, largest * 2.0**-MOST_LEVELS)


def number_of_levels(largest: float, smallest: float, fork: int) -> int:
    """round(log_fork(D / d)) + 1 (Octree-GS), at most `MOST_LEVELS`."""
    return min(round(log(largest / smallest) / log(fork)) + 1, MOST_LEVELS)


def bounding_range(points: NDArray[np.float64]) -> tuple[float, float]:
    """The corner's coordinate, the same for all axes, and the edge of the cube (Octree-GS).

    1.1 times the smallest and the largest coordinate of all points and axes; where all coordinates
    are equal the edge is 0.
    """
    low, high = BOX_FACTOR * float(points.min()), BOX_FACTOR * float(points.max())
    return low, max(high - low, 0.0)


def automatic_root_cell(points: NDArray[np.float64]) -> float:
    """Four median distances between neighbours, local units.

    Twice the automatic voxel of Scaffold-GS: what the farthest cameras see is about as fine as the
    points are dense, however many finer levels there are for near ones.

    Args:
        points: [P, 3] local units.
    """
    return 2.0 * automatic_voxel_size(points)


def root_above(middle_cell: float, levels: int, fork: int) -> float:
    """Edge of level 0's cells where those below the middle level are `middle_cell` (Octree-GS)."""
    return middle_cell * float(fork) ** (levels // 2 - 1)


def resolvable_levels(levels: int, fork: int, cell: float, reach: float) -> int:
    """How many of the levels have cells that float32 positions can tell apart, at least 1.

    Args:
        levels: Wanted.
        fork: Cells of the next level along an edge.
        cell: Edge of a cell of level 0, local units.
        reach: Largest coordinate of a point, local units.
    """
    if reach <= 0.0:
        return levels
    finer = floor(log(cell / (RESOLUTION * reach)) / log(fork))
    return max(1, min(levels, 1 + finer))
