"""Grow and prune anchors on several levels of detail (Octree-GS, Ren et al. 2024)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

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
from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_core.plugin import SHORTEST_ANCHOR_INTERVAL, DensifyContext, Parameters, Schedule


@dataclass(frozen=True)
class Thresholds:
    """The gradient thresholds of all levels.

    Attributes:
        base: Smallest gradient norm for which anchors of level 0 request an anchor, in NDC units.
        ratio: Factor of the threshold from one level to the next.
    """

    base: float
    ratio: float

    def at(self, levels: Tensor) -> Tensor:
        """Return the smallest gradients [A] for which anchors of levels [A] request an anchor."""
        return self.base * self.ratio ** levels.double()


@dataclass(frozen=True)
class Requests:
    """The cells in which N offsets request new anchors.

    Attributes:
        sites: [N, 4] int64, level of each cell and its position in the lattice.
        anchors: [N] int64, the anchors to which the offsets belong.
        strength: [N] gradients of the offsets.
        features: [N, F] feature vectors for the new anchors; -inf without a feature vector.
    """

    sites: Tensor
    anchors: Tensor
    strength: Tensor
    features: Tensor


def requests(
    parameters: Mapping[str, Tensor],
    lattice: Lattice,
    request: GrowthRequest,
    thresholds: Thresholds,
) -> Requests:
    """Return the cells in which the offsets request new anchors.

    An offset of an anchor at level l requests an anchor if its gradient reaches the threshold of
    level l. The requested cell contains the Gaussian of the offset. The cell is on level l + 1 if
    this level exists and the gradient reaches its threshold, else on level l.
    """
    levels = parameters["levels"]
    asks = request.eligible & (request.gradient >= thresholds.at(levels)[:, None])
    anchors, slots = asks.nonzero().unbind(1)
    strength, anchor_levels = request.gradient[anchors, slots], levels[anchors]
    finer = (strength >= thresholds.at(anchor_levels + 1)) & (anchor_levels + 1 < lattice.levels)
    asked = anchor_levels + finer
    places = lattice.coordinates(offset_means(parameters, anchors, slots), asked)
    sites = torch.cat([asked[:, None], cells_of(places, 1.0)], 1)
    features = parameters["features"][anchors].masked_fill(finer[:, None], -torch.inf)
    reached = in_reach(sites)
    return Requests(sites[reached], anchors[reached], strength[reached], features[reached])


def grown(
    parameters: Mapping[str, Tensor],
    request: GrowthRequest,
    thresholds: Thresholds,
    cameras: Tensor,
) -> NewAnchors:
    """Return new anchors in the requested cells that are empty.

    The feature vector of a new anchor is the elementwise maximum over requesting anchors of the
    same level. Without such anchors, the feature vector is 0. New anchors whose level too few
    cameras use are left out.

    Args:
        parameters: The parameters of an octree backbone, detached from autograd.
        request: The requests for new anchors.
        thresholds: The gradient thresholds of all levels.
        cameras: [C, 3] camera centres in local units.

    Returns:
        The new anchors, with the additional tensors `levels` and `extra_levels`.

    Source: Octree-GS (Ren et al. 2024).
    """
    lattice, levels = Lattice.of(parameters["lattice"]), parameters["levels"]
    asked = requests(parameters, lattice, request, thresholds)
    held = cells_of(lattice.coordinates(parameters["anchors"], levels), 1.0)
    first, new_cell = free_cells(asked.sites, torch.cat([levels[:, None], held], 1))
    wanted = new_cell >= 0
    features = largest(asked.features[wanted], new_cell[wanted], len(first))
    strength = largest(asked.strength[wanted, None], new_cell[wanted], len(first))
    at = asked.sites[first, 0]
    positions = lattice.positions(asked.sites[first, 1:], at).to(parameters["anchors"])
    new = NewAnchors(
        positions=positions,
        cells=lattice.cells(at),
        features=features.masked_fill(features.isneginf(), 0.0),
        parents=asked.anchors[first],
        strength=strength[:, 0],
        further={"levels": at, "extra_levels": torch.zeros_like(positions[:, 0])},
    )
    keep_levels = lattice.keep_levels(lattice.shares(positions, at, cameras))
    return new.at(keep_levels.nonzero().squeeze(1))


def seen_from_farther(
    parameters: Mapping[str, Tensor], request: GrowthRequest, thresholds: Thresholds
) -> Tensor:
    """Return a mask [P] of the anchors whose eligible offsets have a large mean gradient.

    Args:
        parameters: The parameters of an octree backbone, detached from autograd.
        request: The requests for new anchors.
        thresholds: The thresholds of the mean gradient, one for each level.

    Source: Octree-GS (Ren et al. 2024).
    """
    count = request.eligible.sum(1)
    mean = (request.gradient * request.eligible).sum(1) / count.clamp(min=1)
    return (count > 0) & (mean >= thresholds.at(parameters["levels"]))


#: The published schedule has 40,000 steps. Anchors are added every 100 steps after step 1500 and
#: before step 25,000.
_LENGTH, _FROM, _UNTIL, _EVERY = 40_000, 1500, 25_000, 100


class OctreeControl(AnchorDensifier):
    """A densifier that adds anchors on the level of the requesting anchor or on the next level.

    The next level is used for larger gradients.

    Anchors are pruned as in Scaffold-GS. No candidate is removed at random. If the offsets of an
    anchor have a large mean gradient, the anchor is afterwards used from slightly larger distances.
    Differences from the published code:

    - An offset on the last level requests an anchor on this level for any gradient above the
      threshold of the level. The published code adds no anchor if the gradient exceeds the
      threshold of the next level, which does not exist.
    - In each edit, each anchor is tested once for an extra level, with the threshold of its own
      level. The published code tests every anchor with the thresholds of all levels, and adds up
      the results.
    - Anchors are also added on a level that is still empty. In the published code, an empty level
      stays empty.
    - If anchors of two levels request one cell in an edit, the feature vectors come from the level
      of the cell.

    As in the published code, the next level and the extra levels are used from the first edit on.
    The authors of the paper probably intended to wait for the end of the coarse phase.
    """

    tensors: ClassVar[frozenset[str]] = AnchorDensifier.tensors | {
        "levels",
        "extra_levels",
        "lattice",
    }

    update_ratio: float = Field(
        0.2, ge=0, description="gradient thresholds grow by fork^update_ratio per level"
    )
    extra_ratio: float = Field(
        0.25,
        ge=0,
        description="an anchor gets an extra level if its mean gradient exceeds this share of the "
        "threshold",
    )
    extra_level: float = Field(0.01, ge=0, description="amount added to an extra level, levels")

    @override
    def window(self, schedule: Schedule) -> Schedule:
        length = _LENGTH if schedule.published else schedule.length
        edited = schedule.with_edits(
            start=length * _FROM // _LENGTH,
            until=length * _UNTIL // _LENGTH,
            every=max(SHORTEST_ANCHOR_INTERVAL, length * _EVERY // _LENGTH),
        )
        return replace(
            edited,
            lr_until=length,
            coarse_until=min(length // 4, schedule.counted(schedule.total) // 2),
            reset_every=None,
        )

    @override
    def grown(
        self, context: DensifyContext, parameters: Parameters, request: GrowthRequest
    ) -> NewAnchors:
        centers = torch.from_numpy(context.scene.centers)
        return grown(parameters, request, self._thresholds(parameters), centers)

    @override
    def changed(self, parameters: Parameters, request: GrowthRequest) -> Mapping[str, Tensor]:
        thresholds = self._thresholds(parameters, self.extra_ratio)
        farther = seen_from_farther(parameters, request, thresholds)
        extra = parameters["extra_levels"] + self.extra_level * farther
        return {**super().changed(parameters, request), "extra_levels": extra}

    def _thresholds(self, parameters: Parameters, share: float = 1.0) -> Thresholds:
        """Return the thresholds of all levels, multiplied by `share`."""
        fork = float(Lattice.of(parameters["lattice"]).fork)
        return Thresholds(share * self.grad_threshold, fork**self.update_ratio)
