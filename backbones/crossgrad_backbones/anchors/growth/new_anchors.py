"""Anchors to be added, and what the present ones ask for."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class GrowthRequest:
    """New anchors at offsets of the present ones.

    Attributes:
        gradient: [P, k] mean gradient norm of each offset, NDC.
        eligible: [P, k] bool, offsets that were seen often enough to be judged.
    """

    gradient: Tensor
    eligible: Tensor

    def among(self, may_grow: Tensor | None) -> "GrowthRequest":
        """That of the anchors that may grow [P]; None: all may."""
        if may_grow is None:
            return self
        return replace(self, eligible=self.eligible & may_grow[:, None])


@dataclass(frozen=True)
class NewAnchors:
    """M anchors to be added.

    Attributes:
        positions: [M, 3] local units.
        cells: [M] edge of the cell that each was made for, local units.
        features: [M, F].
        parents: [M] int64, an anchor whose offset asked for it.
        strength: [M] the largest gradient that asked for it.
        further: Tensor name -> [M, ...], other tensors that are not those of the parents.
    """

    positions: Tensor
    cells: Tensor
    features: Tensor
    parents: Tensor
    strength: Tensor
    further: Mapping[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    def limited(self, room: int) -> tuple["NewAnchors", int]:
        """The strongest `room` of them in their order, and how many were left out."""
        left_out = max(0, len(self) - room)
        if left_out == 0:
            return self, 0
        ranked = torch.argsort(self.strength, descending=True, stable=True)
        return self.at(ranked[:room].sort().values), left_out

    def and_more(self, more: "NewAnchors") -> "NewAnchors":
        """These, then others, which have the same further tensors."""
        return NewAnchors(
            torch.cat([self.positions, more.positions]),
            torch.cat([self.cells, more.cells]),
            torch.cat([self.features, more.features]),
            torch.cat([self.parents, more.parents]),
            torch.cat([self.strength, more.strength]),
            {name: torch.cat([own, more.further[name]]) for name, own in self.further.items()},
        )

    def at(self, rows: Tensor) -> "NewAnchors":
        """Those at `rows` [R]."""
        return NewAnchors(
            self.positions[rows],
            self.cells[rows],
            self.features[rows],
            self.parents[rows],
            self.strength[rows],
            {name: own[rows] for name, own in self.further.items()},
        )


def offset_means(parameters: Mapping[str, Tensor], anchor: Tensor, slot: Tensor) -> Tensor:
    """[N, 3] means of the Gaussians `slot` [N] of anchors `anchor` [N]."""
    stretch = torch.exp(parameters["scales"][anchor, :3])
    return parameters["anchors"][anchor] + parameters["offsets"][anchor, slot] * stretch


def largest(rows: Tensor, group: Tensor, groups: int) -> Tensor:
    """[groups, F] elementwise largest of the rows [N, F] of each group; none is empty."""
    largest = rows.new_full((groups, rows.shape[1]), -torch.inf)
    return largest.scatter_reduce_(0, group[:, None].expand_as(rows), rows, "amax")
