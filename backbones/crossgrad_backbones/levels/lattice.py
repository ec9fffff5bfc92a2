"""The nested lattices of an octree: number of levels, and viewing distance of each level."""

from dataclasses import dataclass, replace
from math import floor, log, log2

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_backbones.anchors.voxels import automatic_voxel_size

#: Maximum number of levels, which is more than any scene needs.
MOST_LEVELS = 16
#: Minimum edge of a cell, as a share of the largest coordinate. Float32 rounds positions to 2^-24
#: of their size.
RESOLUTION = 2.0**-20
#: The bounds of the initial points are moved away from 0 by this factor (Octree-GS).
BOX_FACTOR = 1.1


def root_cell(edge: float, base_layer: int, wanted: float) -> float:
    """Return the edge of a cell of level 0: the cube's edge / 2^base_layer (Octree-GS).

    Args:
        edge: The cube's edge, local units.
        base_layer: Number of halvings of the cube; -1 halves until cells are about `wanted` large.
        wanted: Local units; the result if the cube has no size.
    """
    if edge <= 0.0:
        return wanted
    if base_layer < 0:
        base_layer = round(log2(edge / wanted))
    return edge * 2.0**-base_layer


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cubic lattices, one per level, each `fork` times finer than the level before (Octree-GS).

    All fields are float64 tensors, so that a training step need not wait until a device has sent
    them to the host.

    Attributes:
        origin: [3] corner of the lattices, local units.
        root_cell: [] edge of a cell of level 0, local units.
        fork: [] number of cells of the next level along an edge.
        levels: [] number of levels.
        distance: [] standard distance D, local units: L* = log_fork(D / distance) is 0 at this
            distance.
        lead: [] number of levels beyond L* that a camera sees: 0 if L* is rounded down, 1/2 if it
            is rounded to the nearest level, 1 if it is rounded up.
        visible_share: [] anchors that at most this share of the cameras sees are pruned.
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
        """Unpack the lattices from a tensor [9] of `packed`."""
        return cls(packed[:3], *packed[3:].unbind())

    def packed(self) -> Tensor:
        """Pack all fields into one tensor [9] float64, which a backbone stores as a parameter."""
        scalars = (self.root_cell, self.fork, self.levels, self.distance, self.lead)
        return torch.cat([self.origin, torch.stack([*scalars, self.visible_share])]).double()

    def with_prune_threshold(self, visible_share: float) -> "Lattice":
        """Return the same lattices with another threshold for pruning."""
        return replace(self, visible_share=torch.full_like(self.visible_share, visible_share))

    @property
    def count(self) -> int:
        """Number of levels, on the host."""
        return int(self.levels)

    def cells(self, levels: Tensor) -> Tensor:
        """Return the cell edge [A] float64 of each level [A], local units."""
        return self.root_cell * self.fork ** (-levels.double())

    def coordinates(self, points: Tensor, levels: Tensor) -> Tensor:
        """Return points [A, 3] in units of their levels' cells from the origin, [A, 3] float64.

        Rounding the result gives the nearest lattice site of each point.
        """
        return (points.double() - self.origin) / self.cells(levels)[:, None]

    def positions(self, sites: Tensor, levels: Tensor) -> Tensor:
        """Return the positions [A, 3] float64 of sites [A, 3] of levels [A], local units."""
        return sites.double() * self.cells(levels)[:, None] + self.origin

    def distances(self, anchors: Tensor, levels: Tensor, camera: Tensor) -> Tensor:
        """Return the distances [A] of a camera centre [3] from anchors [A, 3] moved by half a cell.

        Source: Octree-GS, methods of section 6.
        """
        halves = 0.5 * self.root_cell * self._forks(-levels.to(anchors))
        squares = torch.zeros_like(halves)
        at = camera.to(anchors, non_blocking=True)
        for along, center in zip(anchors.unbind(1), at.unbind(), strict=True):
            squares += (along + halves - center).square()
        return squares.sqrt()

    def detail(self, distances: Tensor, extra: Tensor) -> Tensor:
        """Return L* = log_fork(D / distance) + extra level [A]; infinite at distance 0."""
        octaves = torch.log2(self.distance.to(distances) / distances)
        return octaves / torch.log2(self.fork) + extra

    def seen(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """Return a mask [A] of the anchors of levels [A] that are drawn at distances [A].

        An anchor is drawn if its level is at most L* + lead; level 0 is always drawn. A distance
        exactly between two levels belongs to the finer level.
        """
        farthest = self.distance * self._forks(self.lead + extra - levels.to(extra))
        return (levels == 0) | (distances <= farthest)

    def _forks(self, exponents: Tensor) -> Tensor:
        """Return fork^exponents in the number type of `exponents`.

        A step computes this value for every anchor.
        """
        # Do not use exp2, because its rounding depends on the number of threads.
        return torch.exp(torch.log(self.fork) * exponents)

    def faded(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """Return opacity factors [A] in [0, 1] that fade in the boundary level (Octree-GS).

        The finest visible level has the fractional part of L* + 1 as its factor, so that no anchor
        appears or vanishes abruptly when the camera moves. Coarser levels and level 0 have the
        factor 1.
        """
        factor = (self.detail(distances, extra) + 1.0 - levels.to(distances)).clamp(0.0, 1.0)
        return torch.where(levels == 0, torch.ones_like(factor), factor)

    def shares(self, anchors: Tensor, levels: Tensor, cameras: Tensor) -> Tensor:
        """Return for each anchor [A, 3] the share of cameras that see its level, [A] float64.

        Only the distance from the camera centres [C, 3] counts, not the viewing direction.
        """
        extra = torch.zeros_like(anchors[:, 0])
        seen = torch.zeros(anchors.shape[0], dtype=torch.float64, device=anchors.device)
        for camera in cameras:
            seen += self.seen(self.distances(anchors, levels, camera), levels, extra)
        return seen / max(1, cameras.shape[0])

    def keep_levels(self, shares: Tensor) -> Tensor:
        """Return a mask [A] of the anchors that are not pruned, by their share of cameras.

        Anchors that every camera sees always stay. Otherwise, if all cameras are equally far away,
        the option that prunes by the mean share would remove all anchors.
        """
        return (shares > self.visible_share) | (shares >= 1.0)


def distance_range(
    points: NDArray[np.float64], centers: NDArray[np.float64], ratio: float
) -> tuple[float, float]:
    """Return a robust largest and smallest distance between cameras and points (Octree-GS).

    For each camera, the quantiles 1 - ratio and ratio of its distances to all points are computed.
    The result is the same two quantiles of these values.

    Args:
        points: [P, 3], P >= 1.
        centers: [C, 3] camera centres, C >= 1.
        ratio: The quantile, for instance 0.999.

    Returns:
        The standard distance D and the smallest distance d, both positive.
    """
    quantiles = (1.0 - ratio, ratio)
    pooled = [np.quantile(np.linalg.norm(points - c, axis=1), quantiles) for c in centers]
    smallest, largest = (float(value) for value in np.quantile(pooled, quantiles))
    # If all points and all cameras have the same position, any distance is valid.
    largest = largest if largest > 0.0 else 1.0
    return largest, max(smallest, largest * 2.0**-MOST_LEVELS)


def number_of_levels(largest: float, smallest: float, fork: int) -> int:
    """Return round(log_fork(D / d)) + 1 (Octree-GS), at most `MOST_LEVELS`."""
    return min(round(log(largest / smallest) / log(fork)) + 1, MOST_LEVELS)


def bounding_range(points: NDArray[np.float64]) -> tuple[float, float]:
    """Return the lowest corner and the edge of a cube around all points (Octree-GS).

    The corner is one number, because its three coordinates are equal.

    The bounds are 1.1 times the smallest and the largest coordinate of all points and axes. If all
    coordinates are equal, the edge is 0.
    """
    low, high = BOX_FACTOR * float(points.min()), BOX_FACTOR * float(points.max())
    return low, max(high - low, 0.0)


def automatic_root_cell(points: NDArray[np.float64]) -> float:
    """Return four median distances between neighbours, local units.

    This is twice the automatic voxel of Scaffold-GS. The farthest cameras then see anchors about as
    dense as the points, independent of the number of finer levels.

    Args:
        points: [P, 3] local units.
    """
    return 2.0 * automatic_voxel_size(points)


def root_above(middle_cell: float, levels: int, fork: int) -> float:
    """Return the cell edge of level 0 (Octree-GS).

    With this edge, cells of level `levels // 2 - 1` have the edge `middle_cell`.
    """
    return middle_cell * float(fork) ** (levels // 2 - 1)


def resolvable_levels(levels: int, fork: int, cell: float, reach: float) -> int:
    """Return the number of levels whose cells float32 positions can resolve, at least 1.

    Args:
        levels: Wanted number of levels.
        fork: Number of cells of the next level along an edge.
        cell: Edge of a cell of level 0, local units.
        reach: Largest coordinate of a point, local units.
    """
    if reach <= 0.0:
        return levels
    finer = floor(log(cell / (RESOLUTION * reach)) / log(fork))
    return max(1, min(levels, 1 + finer))
