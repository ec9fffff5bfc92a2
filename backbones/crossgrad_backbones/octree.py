"""Octree-GS: neural Gaussians of anchors on several levels of detail (Ren et al. 2024)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.base import AnchorBackbone, Used
from crossgrad_backbones.levels import lattice as fitting
from crossgrad_backbones.levels.lattice import Lattice
from crossgrad_backbones.neighbours import nearest_neighbour_scales
from crossgrad_core.plugin import (
    Block,
    Camera,
    Gaussians,
    LearningRate,
    Parameters,
    Phase,
    Scene,
    Selection,
)


def opening_steps(span: float, count: int, factor: float) -> tuple[float, ...]:
    """Return the steps at which `count` further levels are opened for training.

    The last level is opened at step `span`.

    The time between two openings is divided by `factor` each time. The times form a geometric
    series with the first term span (1 - q) / (1 - q^count) and q = 1 / factor.
    """
    q = 1.0 / factor
    terms = [q**i for i in range(count)]
    scale = span / sum(terms) if terms else 0.0
    return tuple(accumulate(scale * term for term in terms))


def allowed_top(step: int, openings: tuple[float, ...], initial: int) -> int:
    """Return the finest level that is open for training at a step."""
    return initial + sum(step >= opening for opening in openings)


@dataclass(frozen=True, eq=False)
class Planted:
    """Initial anchors of all levels, sorted by level.

    Attributes:
        positions: [A, 3] float64 positions in local units.
        levels: [A] int64 level of each anchor.
        spacings: [A] float64 initial scale of each anchor in local units.
    """

    positions: Tensor
    levels: Tensor
    spacings: Tensor

    def kept(self, mask: Tensor) -> "Planted":
        """Return the anchors for which `mask` [A] is True."""
        return Planted(self.positions[mask], self.levels[mask], self.spacings[mask])


def init_anchors(points: NDArray[np.float64], lattice: Lattice, *, everywhere: bool) -> Planted:
    """Create anchors on every level.

    Each point is rounded to the nearest site, and duplicates are removed.

    Initial scales come from the distances between sites of the same level, including sites without
    an anchor. The published code uses distances to anchors of any level. With these distances,
    coarse anchors start as small as neighbouring fine anchors. A distant camera uses only coarse
    anchors. With such small Gaussians, the image of a distant camera would show gaps.

    Args:
        points: [P, 3] points in local units.
        lattice: The lattices of all levels.
        everywhere: True to create an anchor at every site that contains points. False leaves out
            sites that contain all points of a coarser site, because the anchor would repeat the
            coarser anchor.
    """
    origin = lattice.origin.numpy()
    levels = torch.arange(lattice.count)
    by_level, coarser = [], np.zeros(0, np.int64)
    for level, cell in enumerate(lattice.cells(levels).tolist()):
        sites, site = np.unique(np.round((points - origin) / cell), axis=0, return_inverse=True)
        site = site.reshape(-1)
        positions = sites * cell + origin
        spacings = nearest_neighbour_scales(positions)
        rows = np.arange(len(sites))
        if level > 0 and not everywhere:
            rows = np.unique(site[_parted(coarser, site)])
        numbers = np.full(len(rows), level)
        by_level.append(
            [torch.from_numpy(column) for column in (positions[rows], numbers, spacings[rows])]
        )
        coarser = site
    return Planted(*(torch.cat(column) for column in zip(*by_level, strict=True)))


def _parted(coarser: NDArray[np.int64], site: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask [P].

    The mask is True if the points in the coarser site of a point are spread over several finer
    sites.

    Args:
        coarser: [P] number of each point's site on the coarser level.
        site: [P] number of each point's site on this level.
    """
    pairs = np.unique(np.stack([coarser, site], axis=1), axis=0)
    return np.bincount(pairs[:, 0])[coarser] > 1


def visible_share(shares: Tensor, asked: float) -> float:
    """Return the pruning threshold.

    An anchor stays if more than this share of the cameras uses its level.

    Args:
        shares: [A] share of the cameras that use the level of each anchor.
        asked: Value of the option `visible_threshold`. A negative value means the mean share of all
            anchors.
    """
    return float(shares.mean()) if asked < 0.0 else asked


Rounding = Literal["round", "floor", "ceil", "progressive"]
#: Rounding of L* -> number of levels above L* that a camera uses (see `Lattice.lead`).
_LEADS: Mapping[Rounding, float] = {"round": 0.5, "floor": 0.0, "ceil": 1.0, "progressive": 1.0}


class Octree(AnchorBackbone):
    """Anchors on nested lattices. Nearer cameras use finer levels.

    Octree-GS differs from Scaffold-GS in the initial anchors, and in the anchors that a camera
    uses. A camera uses anchors whose level is at most L* = log_fork(D / distance) + extra level,
    after rounding. D is about the largest distance between a camera and a point. During the first
    quarter of a run, fine levels are opened for training one after another.

    Additional blocks, all frozen: levels [P] int64; extra_levels [P]; lattice [9] float64 (see
    `Lattice`). Learning rates decay over the run, as in Scaffold-GS. Source: Octree-GS (Ren et al.
    2024).
    """

    default_densifier: ClassVar[str] = "octree"

    fork: int = Field(2, ge=2, le=8, description="number of cells of the next level along an edge")
    dist_ratio: float = Field(
        0.999,
        gt=0.5,
        le=1,
        description="quantile of the distances that is used as the largest distance",
    )
    base_layer: int = Field(
        -1,
        ge=-1,
        le=40,
        description="number of halvings from the scene's cube to the root cell; -1: automatic",
    )
    middle_cell: float | None = Field(
        None,
        gt=0,
        description="edge of the cells below the middle level if base_layer is -1, extents; "
        "null: the root cell is four median point distances",
    )
    plant_everywhere: bool = Field(
        default=False,
        description="also create initial anchors that coincide with an anchor of the coarser level",
    )
    init_level: int = Field(
        -1, ge=-1, description="finest level that is trained at first; -1: the middle one"
    )
    visible_threshold: float = Field(
        0.01,
        ge=-1,
        lt=1,
        description="share of the cameras that must see an anchor; -1: the mean share",
    )
    rounding: Rounding = Field("round", description="rounding of L* to a level")
    progressive: bool = Field(default=True, description="open the fine levels one after the other")
    coarse_factor: float = Field(
        1.5, ge=1, description="factor by which the interval between openings shrinks"
    )

    @override
    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        idle = dict(super().unused_options(selection))
        if self.base_layer >= 0:
            idle["middle_cell"] = "base_layer sets the cells; leave out one of the two options"
        if not self.progressive:
            why = "all levels are open from the start (progressive = false); leave the option out"
            idle |= {"init_level": why, "coarse_factor": why}
        return idle

    @override
    def blocks(self) -> tuple[Block, ...]:
        frozen = LearningRate(0.0)
        return (
            *super().blocks(),
            Block("levels", ("levels",), True, "geometry", frozen),
            Block("extra_levels", ("extra_levels",), True, "geometry", frozen),
            Block("lattice", ("lattice",), False, "geometry", frozen),
        )

    @override
    def fitted_to(self, scene: Scene) -> tuple["Octree", tuple[str, ...]]:
        """Return a note if anchors that repeat a coarser anchor are left out."""
        if self.plant_everywhere:
            return self, ()
        note = (
            "anchors that coincide with an anchor of the coarser level are left out; "
            "--set backbone.plant_everywhere=true keeps them"
        )
        return self, (note,)

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        centers = scene.robust_centers
        lattice = self._lattice(scene.points, centers)
        anchors = init_anchors(scene.points, lattice, everywhere=self.plant_everywhere)
        shares = lattice.shares(anchors.positions, anchors.levels, torch.from_numpy(centers))
        lattice = lattice.with_prune_threshold(visible_share(shares, self.visible_threshold))
        anchors = anchors.kept(lattice.keep_levels(shares))
        finest = float(lattice.cells(lattice.levels - 1))
        positions, spacings = anchors.positions.numpy(), anchors.spacings.numpy()
        return {
            **self.created(positions, spacings, finest, scene, rng),
            "levels": anchors.levels,
            "extra_levels": torch.zeros(len(anchors.levels)),
            "lattice": lattice.packed(),
        }

    def _lattice(self, points: NDArray[np.float64], centers: NDArray[np.float64]) -> Lattice:
        largest, smallest = fitting.distance_range(points, centers, self.dist_ratio)
        levels = fitting.number_of_levels(largest, smallest, self.fork)
        corner, edge = fitting.bounding_range(points)
        if self.middle_cell is None:
            wanted = fitting.automatic_root_cell(points)
        else:
            wanted = fitting.root_above(self.middle_cell, levels, self.fork)
        cell = fitting.root_cell(edge, self.base_layer, wanted)
        levels = fitting.resolvable_levels(levels, self.fork, cell, float(np.abs(points).max()))
        scalars = (cell, self.fork, levels, largest, _LEADS[self.rounding], 0.0)
        return Lattice.of(torch.tensor([corner, corner, corner, *scalars], dtype=torch.float64))

    @override
    def used(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Used:
        lattice = Lattice.of(parameters["lattice"])
        levels, extra = parameters["levels"], parameters["extra_levels"]
        distances = lattice.distances(parameters["anchors"].detach(), levels, camera.center)
        mask = lattice.seen(distances, levels, extra)
        top = self._top(parameters, phase)
        if top is not None:
            mask &= levels <= top
        if self.rounding != "progressive":
            return Used(mask)
        return Used(mask, lattice.faded(distances, levels, extra))

    def _top(self, parameters: Mapping[str, Tensor], phase: Phase) -> int | None:
        """Return the finest level that is open for training. Return None if all levels are open."""
        span = phase.schedule.coarse_until
        if not (self.progressive and phase.training and phase.count < span):
            return None
        last = Lattice.of(parameters["lattice"]).count - 1
        initial = (last + 1) // 2 if self.init_level < 0 else self.init_level
        openings = opening_steps(span, max(0, last - initial), self.coarse_factor)
        return allowed_top(phase.count, openings, initial)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        """Bake as the base class does, but leave out anchors whose level no camera uses."""
        used = torch.stack([self.used(parameters, c, phase).mask for c in cameras]).any(0)
        names = {name for block in self.blocks() if block.per_primitive for name in block.tensors}
        rows = {n: t[used] if n in names else t for n, t in parameters.items()}
        return super().bake(rows, phase, cameras)
