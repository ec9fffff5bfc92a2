"""Base of the densifiers of anchors: statistics, pruning and the edit that adds anchors."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.growth.anchor_statistics import (
    GRADIENT,
    OPACITY,
    RENDERS,
    VIEWS,
    observed,
)
from crossgrad_backbones.anchors.growth.new_anchors import GrowthRequest, NewAnchors
from crossgrad_core.plugin import (
    NO_EDIT,
    Densifier,
    DensifyContext,
    Edit,
    Parameters,
    PluginState,
    Rows,
    screen_statistics,
)


class AnchorDensifier(Densifier):
    """Adds anchors where offsets have large gradients; removes those that stay transparent.

    A method says which anchors it adds; the rest is that of Scaffold-GS. Counters of an offset or
    an anchor are cleared once it was seen often enough to be judged, so that what is rarely seen
    keeps gathering.
    """

    tensors: ClassVar[frozenset[str]] = frozenset({"anchors", "offsets", "features", "scales"})
    resets: ClassVar[bool] = False

    grad_threshold: float = Field(2e-4, gt=0, description="mean NDC gradient norm to grow at")
    success_threshold: float = Field(
        0.8,
        ge=0,
        description="an anchor is judged after more views than this share of the interval, "
        "an offset after more renders than half of it",
    )
    prune_opacity: float = Field(0.005, ge=0, description="prune below; sum over the offsets")
    largest_log_scale: float = Field(0.05, description="cap of the Gaussians' log size, extents")

    @abstractmethod
    def grown(
        self, context: DensifyContext, parameters: Parameters, request: GrowthRequest
    ) -> NewAnchors:
        """The anchors to be added, given what their offsets ask for.

        Args:
            context: The step.
            parameters: Its parameters, detached.
            request: What the offsets ask for.
        """

    def changed(self, parameters: Parameters, request: GrowthRequest) -> Mapping[str, Tensor]:
        """New rows of tensors [P, ...] of the present anchors; by default the capped scales."""
        scales = parameters["scales"]
        capped = scales[:, 3:].clamp(max=self.largest_log_scale)
        return {"scales": torch.cat([scales[:, :3], capped], 1)}

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.collects(context.step):
            return NO_EDIT, PluginState()
        # Published: statistics from step 500, edits from step 1500 on.
        if context.schedule.counted(context.step) > context.schedule.densify_from // 3:
            state = observed(context, state)
        if not (state.per_primitive and context.schedule.densifies(context.step)):
            return NO_EDIT, state
        return self._edited(context, state)

    def _edited(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        sums = state.per_primitive
        parameters = {name: tensor.detach() for name, tensor in context.parameters.items()}
        enough = self.success_threshold * context.schedule.densify_every * context.share
        judged = sums[VIEWS] > enough
        transparent = sums[OPACITY] < self.prune_opacity * sums[VIEWS]
        request = GrowthRequest(
            screen_statistics.mean(sums, GRADIENT, RENDERS), sums[RENDERS] > enough / 2
        )
        allowed = request.among(context.may_grow)
        new, held_back = self.grown(context, parameters, allowed).limited(context.room)
        changed = self.changed(parameters, request)
        edit = edit_of(parameters, changed, judged & transparent, new)
        if held_back > 0:
            edit = replace(edit, counts={**edit.counts, "held_back": held_back})
        return edit, PluginState(per_primitive=_cleared(state, request.eligible, judged))


def edit_of(
    parameters: Parameters, changed: Mapping[str, Tensor], pruned: Tensor, new: NewAnchors
) -> Edit:
    """The edit that changes rows of the present anchors, removes `pruned` [P] and adds `new`."""
    really = {n: rows for n, rows in changed.items() if not torch.equal(rows, parameters[n])}
    if len(new) == 0 and not bool(pruned.any()):
        return Edit(values={name: Rows(rows, keep_moments=True) for name, rows in really.items()})
    stay = (~pruned).nonzero().squeeze(1)
    source = torch.cat([stay, new.parents])
    added = torch.arange(len(source), device=source.device) >= len(stay)
    first = _first_values(parameters, new)
    rows = added.nonzero().squeeze(1)
    values = {name: Rows(tensor, rows) for name, tensor in first.items()}
    for name, tensor in really.items():
        beginning = first.get(name, tensor[new.parents])
        values[name] = Rows(torch.cat([tensor[stay], beginning]), keep_moments=True)
    return Edit(source, added, values, {"grown": len(new), "pruned": int(pruned.sum())})


def _first_values(parameters: Parameters, new: NewAnchors) -> dict[str, Tensor]:
    """What new anchors start with; other tensors are those of their parents."""
    scales, offsets = parameters["scales"], parameters["offsets"]
    return {
        "anchors": new.positions,
        "offsets": offsets.new_zeros(len(new), *offsets.shape[1:]),
        "features": new.features,
        "scales": new.cells.log().to(scales)[:, None].repeat(1, scales.shape[1]),
        **new.further,
    }


def _cleared(state: PluginState, eligible: Tensor, judged: Tensor) -> dict[str, Tensor]:
    """The sums, zero for offsets that were eligible and anchors that were judged."""
    done = {GRADIENT: eligible, RENDERS: eligible, OPACITY: judged, VIEWS: judged}
    return {name: state.per_primitive[name].masked_fill(done[name], 0.0) for name in done}
