"""Grow and prune anchors (Scaffold-GS, Lu et al. 2024, section 3.3)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.growth.anchor_base import (
    AnchorDensifier,
    GrowthRequest,
    NewAnchors,
    largest,
    offset_means,
)
from crossgrad_backbones.anchors.voxels import cells_of, free_cells, in_reach
from crossgrad_core.plugin import DensifyContext, Parameters, Schedule, Selection


@dataclass(frozen=True)
class Level:
    """A cell size at which anchors are added, with its threshold.

    Attributes:
        cell: Edge of a cell in local units.
        threshold: Smallest gradient norm for which an anchor is added, in NDC units.
        keep: Probability with which a candidate is kept.
    """

    cell: float
    threshold: float
    keep: float


def grown(
    parameters: Mapping[str, Tensor],
    gradient: Tensor,
    eligible: Tensor,
    levels: tuple[Level, ...],
    rng: np.random.Generator,
) -> NewAnchors:
    """Return new anchors at the Gaussians of the present anchors.

    The levels are processed in order.

    If the first level adds no anchor, the other levels are skipped. At each later level, growth
    also ends if no anchor has been added so far. Anchors that were added at earlier levels occupy
    their cells, but request no anchors.

    Args:
        parameters: `anchors` [P, 3], `offsets` [P, k, 3], `features` [P, F], `scales` [P, 6].
        gradient: [P, k] mean gradient norm of each offset, in NDC units.
        eligible: [P, k] bool, True for offsets that were visible often enough.
        levels: The levels, from coarse to fine cells.
        rng: Random generator that chooses which candidates are kept.

    Source: Scaffold-GS, section 3.3.
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
    """Return the new anchors of one level.

    The cells of the new anchors contain none of the `present` anchors [N, 3].
    """
    anchor, slot = (eligible & (gradient >= level.threshold)).nonzero().unbind(1)
    kept = torch.from_numpy(rng.random(len(anchor)) < level.keep).to(anchor.device)
    anchor, slot = anchor[kept], slot[kept]
    cells = cells_of(offset_means(parameters, anchor, slot), level.cell)
    reached = in_reach(cells)
    anchor, slot, cells = anchor[reached], slot[reached], cells[reached]
    first, new_cell = free_cells(cells, cells_of(present, level.cell))
    wanted = new_cell >= 0
    return NewAnchors(
        positions=(cells[first].double() * level.cell).to(present),
        cells=torch.full((len(first),), level.cell, dtype=torch.float64, device=present.device),
        features=largest(parameters["features"][anchor][wanted], new_cell[wanted], len(first)),
        parents=anchor[first],
        strength=largest(gradient[anchor, slot][wanted, None], new_cell[wanted], len(first))[:, 0],
    )


class AnchorControl(AnchorDensifier):
    """A densifier that adds anchors in empty cells of several sizes, coarse cells first."""

    tensors: ClassVar[frozenset[str]] = AnchorDensifier.tensors | {"voxel_size"}

    threshold_factor: float = Field(
        2.0, ge=1, description="factor of the gradient threshold per level"
    )
    levels: int = Field(3, ge=1, description="number of cell sizes, from coarse to fine")
    coarsest: int = Field(16, ge=1, description="edge of the coarsest cell, voxels")
    refinement: int = Field(4, ge=2, description="ratio of the edges of successive levels")

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        if self.levels > 1:
            return {}
        why = "there is only one cell size (levels = 1); leave the option out"
        return {"threshold_factor": why, "refinement": why}

    @override
    def window(self, schedule: Schedule) -> Schedule:
        edited = schedule.with_edits(
            start=schedule.anchors_from,
            until=schedule.densify_until,
            every=schedule.anchors_every,
        )
        return replace(edited, reset_every=None)

    @override
    def grown(
        self, context: DensifyContext, parameters: Parameters, request: GrowthRequest
    ) -> NewAnchors:
        levels = self._levels(float(parameters["voxel_size"]))
        return grown(parameters, request.gradient, request.eligible, levels, context.rng)

    def _levels(self, voxel: float) -> tuple[Level, ...]:
        """Return the growth levels for voxels with the edge `voxel`."""
        return tuple(
            Level(
                cell=voxel * max(1, self.coarsest // self.refinement**level),
                threshold=self.grad_threshold * self.threshold_factor**level,
                keep=1.0 - 0.5 ** (level + 1),
            )
            for level in range(self.levels)
        )
