"""Where anchors of an octree grow: into free cells of their own level or of the next one."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from crossgrad_backbones.anchors.growth.cells import cells_of, free_cells, in_reach
from crossgrad_backbones.anchors.growth.new_anchors import (
    GrowthRequest,
    NewAnchors,
    largest,
    offset_means,
)
from crossgrad_backbones.levels.lattice import Lattice


@dataclass(frozen=True)
class Thresholds:
    """Gradients that ask for growth, level by level.

    Attributes:
        base: Least gradient that grows at level 0, NDC norm.
        ratio: From one level to the next.
    """

    base: float
    ratio: float

    def at(self, levels: Tensor) -> Tensor:
        """[A] float64, least gradient that grows at levels [A]."""
        return self.base * self.ratio ** levels.double()


@dataclass(frozen=True)
class Requests:
    """The cells that N offsets ask for.

    Attributes:
        sites: [N, 4] int64, level and place in its lattice.
        anchors: [N] int64, the anchors of the offsets.
        strength: [N] gradients of the offsets.
        features: [N, F] what the offset offers to the new anchor, -inf where nothing.
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
    """What the offsets ask for.

    An offset of an anchor of level l asks where its gradient reaches the threshold of that level:
    for the cell around its Gaussian, of level l, or of level l + 1 where the gradient reaches that
    level's threshold as well. There is no level beyond the last.
    """
    levels = parameters["levels"]
    asks = request.eligible & (request.gradient >= thresholds.at(levels)[:, None])
    anchors, slots = asks.nonzero().unbind(1)
    strength, own = request.gradient[anchors, slots], levels[anchors]
    finer = (strength >= thresholds.at(own + 1)) & (own + 1 < lattice.levels)
    asked = own + finer
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
    """New anchors in the free cells that offsets ask for.

    A new anchor has the elementwise largest feature of the anchors of its own level that asked for
    it, or 0 where there is none. Anchors that too few cameras would see are weeded out.

    Args:
        parameters: Those of an octree backbone, detached.
        request: What the offsets ask for.
        thresholds: From which gradients they grow.
        cameras: [C, 3] camera centres, local units.

    Returns:
        The anchors, with the further tensors `levels` and `extra_levels`.

    Source: Octree-GS; methods of section 6.
    """
    lattice, levels = Lattice.of(parameters["lattice"]), parameters["levels"]
    asked = requests(parameters, lattice, request, thresholds)
    held = cells_of(lattice.coordinates(parameters["anchors"], levels), 1.0)
    first, place = free_cells(asked.sites, torch.cat([levels[:, None], held], 1))
    wanted = place >= 0
    features = largest(asked.features[wanted], place[wanted], len(first))
    strength = largest(asked.strength[wanted, None], place[wanted], len(first))
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
    """[P] bool, anchors whose eligible offsets have a mean gradient above their level's threshold.

    Args:
        parameters: Those of an octree backbone, detached.
        request: What the offsets ask for.
        thresholds: Those that the mean must reach.

    Source: Octree-GS; methods of section 6.
    """
    count = request.eligible.sum(1)
    mean = (request.gradient * request.eligible).sum(1) / count.clamp(min=1)
    return (count > 0) & (mean >= thresholds.at(parameters["levels"]))
