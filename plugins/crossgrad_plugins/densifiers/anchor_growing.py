"""Where anchors grow: from offsets with large gradients into free cells of three sizes."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from crossgrad_plugins.densifiers.cells import cells_of, free_cells, in_reach


@dataclass(frozen=True)
class Level:
    """One size of cells.

    Attributes:
        cell: Edge of a cell, local units.
        threshold: Least gradient that grows into it, NDC norm.
        keep: Probability with which a candidate is kept.
    """

    cell: float
    threshold: float
    keep: float


@dataclass(frozen=True)
class Urge:
    """What the offsets of the present anchors ask for.

    Attributes:
        gradient: [P, k] mean gradient norm of each offset, NDC.
        eligible: [P, k] bool, offsets that were seen often enough to be judged.
    """

    gradient: Tensor
    eligible: Tensor


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


def grown(
    parameters: Mapping[str, Tensor],
    gradient: Tensor,
    eligible: Tensor,
    levels: tuple[Level, ...],
    rng: np.random.Generator,
) -> NewAnchors:
    """New anchors from the offsets of the present ones, level by level.

    A level is skipped once none before it has added an anchor. Anchors of this call take their
    cells but do not grow themselves.

    Args:
        parameters: `anchors` [P, 3], `offsets` [P, k, 3], `features` [P, F], `scales` [P, 6].
        gradient: [P, k] mean gradient norm of each offset.
        eligible: [P, k] bool, offsets that were seen often enough.
        levels: From coarse to fine.
        rng: Draws which candidates are kept.

    Source: Scaffold-GS, section 3.3; methods of section 2.6.
    """
    added = _at_level(parameters, parameters["anchors"], gradient, eligible, levels[0], rng)
    for level in levels[1:]:
        if len(added) == 0:
            break
        taken = torch.cat([parameters["anchors"], added.positions])
        added = added.and_more(_at_level(parameters, taken, gradient, eligible, level, rng))
    return added


def _at_level(
    parameters: Mapping[str, Tensor],
    present: Tensor,
    gradient: Tensor,
    eligible: Tensor,
    level: Level,
    rng: np.random.Generator,
) -> NewAnchors:
    """New anchors of one level, where no present one [N, 3] is in the cell."""
    anchor, slot = (eligible & (gradient >= level.threshold)).nonzero().unbind(1)
    kept = torch.from_numpy(rng.random(len(anchor)) < level.keep).to(anchor.device)
    anchor, slot = anchor[kept], slot[kept]
    cells = cells_of(offset_means(parameters, anchor, slot), level.cell)
    reached = in_reach(cells)
    anchor, slot, cells = anchor[reached], slot[reached], cells[reached]
    first, place = free_cells(cells, cells_of(present, level.cell))
    wanted = place >= 0
    return NewAnchors(
        positions=(cells[first].double() * level.cell).to(present),
        cells=torch.full((len(first),), level.cell, dtype=torch.float64, device=present.device),
        features=largest(parameters["features"][anchor][wanted], place[wanted], len(first)),
        parents=anchor[first],
        strength=largest(gradient[anchor, slot][wanted, None], place[wanted], len(first))[:, 0],
    )


def offset_means(parameters: Mapping[str, Tensor], anchor: Tensor, slot: Tensor) -> Tensor:
    """[N, 3] means of the Gaussians `slot` [N] of anchors `anchor` [N]."""
    stretch = torch.exp(parameters["scales"][anchor, :3])
    return parameters["anchors"][anchor] + parameters["offsets"][anchor, slot] * stretch


def largest(rows: Tensor, group: Tensor, groups: int) -> Tensor:
    """[groups, F] elementwise largest of the rows [N, F] of each group; none is empty."""
    largest = rows.new_full((groups, rows.shape[1]), -torch.inf)
    return largest.scatter_reduce_(0, group[:, None].expand_as(rows), rows, "amax")
