"""Growing and pruning of anchors (Scaffold-GS, Lu et al. 2024, section 3.3)."""

from dataclasses import replace
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.blocks import Parameters
from crossgrad_core.contexts import DensifyContext
from crossgrad_core.densifier import Densifier
from crossgrad_core.schedule import Schedule
from crossgrad_core.state import PluginState
from crossgrad_core.topology import NO_EDIT, Edit, NoEdit, Rows
from crossgrad_plugins.densifiers.anchor_growing import Level, NewAnchors, grown
from crossgrad_plugins.densifiers.anchor_statistics import (
    GRADIENT,
    OPACITY,
    RENDERS,
    VIEWS,
    observed,
)
from crossgrad_plugins.densifiers.screen_statistics import mean


class AnchorControl(Densifier):
    """Adds anchors where offsets have large gradients; removes those that stay transparent.

    Counters of an offset or an anchor are cleared once it was seen often enough to be judged, so
    that what is rarely seen keeps gathering.
    """

    blocks: ClassVar[frozenset[str]] = frozenset(
        {"anchors", "offsets", "features", "scales", "voxel_size"}
    )

    grad_threshold: float = Field(2e-4, gt=0, description="mean NDC gradient norm to grow at")
    threshold_factor: float = Field(2.0, ge=1, description="factor of the threshold per level")
    levels: int = Field(3, ge=1, description="sizes of cells, from coarse to fine")
    coarsest: int = Field(16, ge=1, description="edge of the coarsest cell, voxels")
    refinement: int = Field(4, ge=2, description="ratio of the edges of successive levels")
    grow_renders: float = Field(40, ge=0, description="an offset grows after more renders")
    prune_views: float = Field(80, ge=0, description="an anchor is judged after more views")
    prune_opacity: float = Field(0.005, ge=0, description="prune below; sum over the offsets")
    largest_log_scale: float = Field(0.05, description="cap of the Gaussians' log size, extents")

    @override
    def window(self, schedule: Schedule) -> Schedule:
        return replace(schedule, densify_from=schedule.anchors_from, reset_every=None)

    @override
    def densify(
        self, context: DensifyContext, state: PluginState
    ) -> tuple[Edit | NoEdit, PluginState]:
        if not context.schedule.collects(context.step):
            return NO_EDIT, PluginState()
        # Statistics begin at T / 60: step 500 of the published schedule.
        if context.step > context.schedule.lr_steps // 60:
            state = observed(context, state)
        if not (state.per_primitive and context.schedule.densifies(context.step)):
            return NO_EDIT, state
        return self._edited(context, state)

    def _edited(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        sums = state.per_primitive
        parameters = {name: tensor.detach() for name, tensor in context.parameters.items()}
        eligible = sums[RENDERS] > self.grow_renders
        judged = sums[VIEWS] > self.prune_views
        transparent = sums[OPACITY] < self.prune_opacity * sums[VIEWS]
        gradient = mean(sums, GRADIENT, RENDERS)
        levels = self._levels(float(parameters["voxel_size"]))
        new = grown(parameters, gradient, eligible, levels, context.rng)
        new, held_back = new.limited(context.room)
        edit = self._edit(parameters, judged & transparent, new)
        if held_back > 0:
            edit = replace(edit, counts={**edit.counts, "held_back": held_back})
        return edit, PluginState(per_primitive=_cleared(state, eligible, judged))

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

    def _edit(self, parameters: Parameters, pruned: Tensor, new: NewAnchors) -> Edit:
        scales = parameters["scales"]
        capped = torch.cat([scales[:, :3], scales[:, 3:].clamp(max=self.largest_log_scale)], 1)
        values = {"scales": Rows(capped, keep_moments=True)}
        if len(new) == 0 and not bool(pruned.any()):
            return Edit(values={} if torch.equal(capped, scales) else values)
        stay = (~pruned).nonzero().squeeze(1)
        source = torch.cat([stay, new.parents])
        rows = torch.arange(len(stay), len(source), device=source.device)
        added = new.cells.log().to(scales)[:, None].expand(-1, scales.shape[1])
        values = {
            "anchors": Rows(new.positions, rows),
            "offsets": Rows(torch.zeros_like(parameters["offsets"][new.parents]), rows),
            "features": Rows(new.features, rows),
            "scales": Rows(torch.cat([capped[stay], added]), keep_moments=True),
        }
        fresh = torch.arange(len(source), device=source.device) >= len(stay)
        return Edit(source, fresh, values, {"grown": len(new), "pruned": int(pruned.sum())})


def _cleared(state: PluginState, eligible: Tensor, judged: Tensor) -> dict[str, Tensor]:
    """The sums, zero for offsets that were eligible and anchors that were judged."""
    done = {GRADIENT: eligible, RENDERS: eligible, OPACITY: judged, VIEWS: judged}
    return {name: state.per_primitive[name].masked_fill(done[name], 0.0) for name in done}
