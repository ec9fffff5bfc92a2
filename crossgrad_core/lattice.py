"""Nested lattices: where the anchors of an octree stand and from how far each level is seen."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Lattice:
    """Cubic lattices, one per level, each `fork` times finer than the one before (Octree-GS).

    All fields are float64 tensors, so that none has to travel to the host where a step uses them.

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

    @property
    def count(self) -> int:
        """Number of levels, on the host."""
        return int(self.levels)

    def cells(self, levels: Tensor) -> Tensor:
        """[A] float64, edge of a cell of each level [A], local units."""
        return self.root_cell * self.fork ** (-levels.double())

    def sites(self, points: Tensor, levels: Tensor) -> Tensor:
        """[A, 3] int64, the lattice site next to each point [A, 3] at its level [A]."""
        cells = self.cells(levels)[:, None]
        return torch.round((points.double() - self.origin) / cells).long()

    def positions(self, sites: Tensor, levels: Tensor) -> Tensor:
        """[A, 3] float64, where sites [A, 3] of levels [A] are, local units."""
        return sites.double() * self.cells(levels)[:, None] + self.origin

    def distances(self, anchors: Tensor, levels: Tensor, camera: Tensor) -> Tensor:
        """[A] distance of a camera centre [3] from anchors [A, 3] moved by half a cell.

        Source: Octree-GS, methods of section 6.
        """
        halves = (0.5 * self.cells(levels)).to(anchors)
        return torch.linalg.vector_norm(anchors - camera.to(anchors) + halves[:, None], dim=1)

    def detail(self, distances: Tensor, extra: Tensor) -> Tensor:
        """[A] L* = log_fork(D / distance) + extra level; infinite at distance 0."""
        octaves = torch.log2(self.distance.to(distances) / distances)
        return octaves / torch.log2(self.fork).to(distances) + extra

    def seen(self, distances: Tensor, levels: Tensor, extra: Tensor) -> Tensor:
        """[A] bool, whether anchors of levels [A] are drawn at distances [A] from a camera.

        An anchor is drawn where its level is at most L* + lead; level 0 always is. A distance that
        is exactly between two levels belongs to the finer one.
        """
        farthest = self.distance * self.fork ** (self.lead + extra.double() - levels.double())
        return (levels == 0) | (distances <= farthest.to(distances))

    def shares(self, anchors: Tensor, levels: Tensor, cameras: Tensor) -> Tensor:
        """[A] float64, share of the cameras (centres [C, 3]) that see each anchor [A, 3]'s level.

        Only the distance counts, not the direction in which a camera looks.
        """
        extra = torch.zeros_like(anchors[:, 0])
        seen = torch.zeros(anchors.shape[0], dtype=torch.float64, device=anchors.device)
        for camera in cameras:
            seen += self.seen(self.distances(anchors, levels, camera), levels, extra)
        return seen / max(1, cameras.shape[0])

    def lasting(self, shares: Tensor) -> Tensor:
        """[A] bool, anchors that are not weeded out, by the share of cameras that see them.

        What every camera sees always stays: with an automatic threshold (the mean share) and all
        cameras equally far away, nothing would be left otherwise.
        """
        return (shares > self.visible_share) | (shares >= 1.0)


def unique_sites(sites: Tensor) -> tuple[Tensor, Tensor]:
    """Which rows of sites [A, 3] are the same, without sorting triples.

    Returns:
        [A] number of each row's site, in the sites' lexicographic order, and [U] the first row of
        each of the U sites.
    """
    number = torch.zeros_like(sites[:, 0])
    for column in sites.unbind(1):
        # Ranks instead of the coordinates themselves: a product of two of them cannot overflow.
        values, rank = torch.unique(column, return_inverse=True)
        number = torch.unique(number * len(values) + rank, return_inverse=True)[1]
    count = int(number.max()) + 1 if number.numel() else 0
    rows = torch.arange(len(number), device=sites.device)
    first = torch.full((count,), len(number), dtype=torch.int64, device=sites.device)
    return number, first.scatter_reduce(0, number, rows, "amin")
