"""Growing and pruning of anchors (Scaffold-GS, Lu et al. 2024, section 3.3)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from pydantic import Field
from typing_extensions import override

from crossgrad_backbones.anchors.growth.anchor_base import AnchorDensifier
from crossgrad_backbones.anchors.growth.anchor_growing import Level, grown
from crossgrad_backbones.anchors.growth.new_anchors import GrowthRequest, NewAnchors
from crossgrad_core.plugin import DensifyContext, Parameters, Schedule, Selection


class AnchorControl(AnchorDensifier):
    """Grows anchors into free cells of three sizes, coarse ones first."""

    tensors: ClassVar[frozenset[str]] = AnchorDensifier.tensors | {"voxel_size"}

    threshold_factor: float = Field(2.0, ge=1, description="factor of the threshold per level")
    levels: int = Field(3, ge=1, description="sizes of cells, from coarse to fine")
    coarsest: int = Field(16, ge=1, description="edge of the coarsest cell, voxels")
    refinement: int = Field(4, ge=2, description="ratio of the edges of successive levels")

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        if self.levels > 1:
            return {}
        why = "there is one size of cells (levels = 1); leave it out"
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
        """The levels of growth for voxels of that edge."""
        return tuple(
            Level(
                cell=voxel * max(1, self.coarsest // self.refinement**level),
                threshold=self.grad_threshold * self.threshold_factor**level,
                keep=1.0 - 0.5 ** (level + 1),
            )
            for level in range(self.levels)
        )
