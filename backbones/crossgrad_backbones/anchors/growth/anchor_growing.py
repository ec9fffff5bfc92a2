"""Where anchors grow: from offsets with large gradients into free cells of three sizes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from crossgrad_backbones.anchors.growth.cells import cells_of, free_cells, in_reach
from crossgrad_backbones.anchors.growth.new_anchors import NewAnchors, largest, offset_means


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
